"""Bodies that come from files, as a scene names them: surfaces, meshes and images of labels."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from palpate.shared.part import Length, Part, in_radii, optional
from palpate.shared.place import Place

Unit = Annotated[Literal["mm", "cm", "m"], Field(description="of lengths in the file: mm, cm or m")]

CHOSEN = "the coarsest mesh whose errors leave the reduction its share of the tolerance"

MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
"""Of each unit."""

Label = Annotated[int, Field(ge=1, le=65_535)]


Deviation = Annotated[
    Length,
    in_radii(
        0.15, "how far the mesh may lie from the surface, mm; sharp edges twice as far from it"
    ),
]
Edge = Annotated[Length, in_radii(2.0, "longest edges of the mesh before it is refined, mm")]


class Finer(Place):
    """Part of the boundary with shorter edges than elsewhere."""

    finest: Length = Field(description="longest edges there, mm")

    @classmethod
    def places(cls) -> tuple[str, ...]:
        """Keys that say where."""
        return tuple(Place.model_fields)


class _OfFile(Part):
    sides: ClassVar = ()
    element: ClassVar = "tet10"
    fineness: ClassVar = "finest"
    finest: Length | None = optional(
        CHOSEN, "longest edges of elements where it can be touched and where what is held ends, mm"
    )
    finer: Finer | None = optional("nowhere", "where edges have to be shorter than that")


class SurfaceBody(_OfFile):
    """The inside of a closed surface."""

    kind: Literal["surface"] = Field(description="inside of a closed surface from a file")
    file: str = Field(min_length=1, description="STL, OBJ or PLY file beside the scene file")
    unit: Unit
    deviation: Deviation
    edge: Edge


class MeshBody(_OfFile):
    """A mesh of tetrahedra or of cells that are split into tetrahedra."""

    kind: Literal["mesh"] = Field(description="mesh from a file, of tetrahedra or hexahedra")
    file: str = Field(min_length=1, description="VTU, VTK or MSH file beside the scene file")
    unit: Unit


class LabelBody(_OfFile):
    """What has some of the labels of a segmented image."""

    kind: Literal["labels"] = Field(description="labels of a segmented image; x right, y anterior")
    file: str = Field(
        min_length=1, description="NIfTI (.nii, .nii.gz) or NRRD file beside the scene file"
    )
    labels: tuple[Label, ...] = Field(min_length=1, description="numbers of the body's labels")
    smoothing: Annotated[float, Field(ge=0, le=100)] | None = optional(
        "half the longest edge of a voxel",
        "standard deviation of the Gauss filter that rounds the steps of voxels, mm",
    )
    deviation: Deviation
    edge: Edge


FileBody = SurfaceBody | MeshBody | LabelBody
