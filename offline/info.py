"""What an artifact holds, read without building the model: for people or, as a whole, for JSON."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from palpate.offline.bodies.report import in_words
from palpate.shared.artifact import ArtifactError, read_artifact
from palpate.shared.geometry.surface import Surface
from palpate.shared.local_models import LoadRange, Mesh
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.reduced.press import TOLERANCE
from palpate.shared.scene import Scene, SceneError, parse_scene

LABELS, WIDTH = 14, 14  # of the columns of ``lines`` and ``budget``

COLUMNS = {"displacement": "displacement", "von_mises": "von Mises", "force": "tip's force"}
"""What errors are of."""


def info(artifact: Path) -> dict[str, Any]:
    """Everything an artifact tells of itself, JSON-able.

    Beside the documents of training (``provenance``, ``training``, ``validation`` and others) the
    scene, its ``text`` in TOML, ``body`` (box in mm) and ``loads`` (limits in kPa, degrees, mm).

    Raises
    ------
    ArtifactError
    """
    names = "nodes", "elements", "load_range", "surface_vertices", "surface_normals"
    found = read_artifact(artifact, Mesh, Surface, LoadRange)
    try:
        scene = parse_scene(found.scene)
    except SceneError as error:
        raise ArtifactError(f"{artifact}: incomplete or inconsistent: {error}") from error
    nodes, elements, limits, vertices, normals = (found.arrays[name] for name in names)
    depths, radius = limits[:, TIP_DEPTH], scene.endoscope.radius
    middle = int(np.argmin(np.linalg.norm(vertices - vertices.mean(axis=0), axis=1)))
    return {
        "scene": scene.name,
        "description": scene.description,
        "text": scene.text,
        "bytes": artifact.stat().st_size,
        "body": {
            "box": [nodes.min(axis=0).tolist(), nodes.max(axis=0).tolist()],
            "dofs": nodes.size,
            "elements": len(elements),
        },
        "loads": {
            "largest_pressure": float(limits[:, 0].max()),
            "smallest_pressure_limit": float(limits[:, 0].min()),
            "largest_tilt": scene.endoscope.max_tilt,
            "radius": scene.endoscope.radius,
            "tip_depth_limits": [float(depths.min()), float(depths.max())]
            if scene.endoscope.tip
            else None,
            "example": {
                "at": vertices[middle].tolist(),
                "pressure": float(limits[middle, 0]) / 2,
                "tip": (vertices[middle] + (radius - depths[middle] / 2) * normals[middle]).tolist()
                if scene.endoscope.tip
                else None,
            },
        },
    } | found.documents


def lines(report: Mapping[str, Any]) -> list[str]:
    """What ``info`` found, a line for each aspect."""
    scene = parse_scene(report["text"])
    box = zip("xyz", *report["body"]["box"], strict=True)
    layout, provenance = report["training"]["layout"], report["provenance"]
    loads, depths = report["loads"], report["loads"]["tip_depth_limits"]
    said = {
        "scene": f"{scene.name}: {scene.description}",
        "body": ", ".join(f"{axis} {low:z.1f} to {high:.1f}" for axis, low, high in box)
        + f" mm; {report['body']['elements']} elements {scene.geometry.element}, "
        f"{report['body']['dofs']} DOFs",
        **(in_words(report["training"]["file"]) if "file" in report["training"] else {}),
        "tissue": _tissue(scene),
        "held": scene.support.in_words(),
        "touchable": scene.surface.in_words(),
        "loads": f"pressure up to {loads['smallest_pressure_limit']:.3g} (softest place) to "
        f"{loads['largest_pressure']:.3g} kPa (stiffest), radius {loads['radius']:g} mm, tilt up "
        f"to {loads['largest_tilt']:g} degrees",
        "rigid tip": f"up to {depths[0]:.2g} to {depths[1]:.2g} mm deep, depending on the place"
        if depths
        else "not trained, so there are no sessions",
        **accuracy(report),
        "made": f"{provenance['started'][:10]} in {duration(provenance['wall_seconds'])}, commit "
        f"{provenance['git_commit'][:12]}; {report['bytes'] / 1e6:.1f} MB, {layout['patches']} "
        f"local models of {layout['modes']} modes and {layout['cubature_points_median']:g} points",
    }
    return labelled(said)


def labelled(said: Mapping[str, str]) -> list[str]:
    """Lines that begin with what they are about."""
    return [f"{label:<{LABELS}} {text}" for label, text in said.items()]


def accuracy(report: Mapping[str, Any]) -> dict[str, str]:
    """Errors that training found, by what presses."""
    said = {}
    for label, found, mesh in _validations(report):
        names = [name for name in COLUMNS if name in found]
        own = ", ".join(f"{COLUMNS[name]} {percent(found[name]['p95'])}" for name in names)
        said[label] = f"95 of 100 within: {own}; by the mesh: " + ", ".join(
            percent(mesh.get(name, {}).get("p95", math.nan)) for name in names
        )
    return said


def trust(report: Mapping[str, Any]) -> dict[str, str]:
    """How far estimates of errors hold, and how many right answers they cast doubt on."""
    said = {}
    for label, found, _ in _validations(report):
        flagged = found["flagged"]
        said[label.replace("errors", "trust")] = (
            f"covers 95 % of errors, confidence {percent(found['confidence'])}; doubts "
            + (f"{percent(flagged['share'])} of right ones" if flagged["right"] else "all")
            + (f", most for {flagged['mostly']}" if flagged["mostly"] and flagged["share"] else "")
        )
    return said


def budget(report: Mapping[str, Any]) -> list[str]:
    """A table of what each source of errors has of them, and how far their estimates hold."""
    training, scene = report["training"], parse_scene(report["text"])
    tip = report.get("validation_tip", {})

    def allowed(pressed_by_tip: bool) -> dict[str, dict[str, float]]:
        most = scene.tolerance.of(pressed_by_tip).total._asdict()
        return {name: {"p95": value} for name, value in most.items()}

    sources = {
        "mesh": training["mesh_errors"],
        **({"- of the tip": training["mesh_errors_tip"]} if "mesh_errors_tip" in training else {}),
        "reduction": report["validation"] | ({"force": tip["force"]} if tip else {}),
        "- cubature": training["cubature_errors"],
        "- solver": {"displacement": {"p95": TOLERANCE * math.sqrt(scene.tolerance.looseness)}},
        "tolerance": allowed(False),
        **({"- under it": allowed(True)} if tip else {}),
    }
    columns = {name: text for name, text in COLUMNS.items() if tip or name != "force"}
    rows = {
        source: [percent(found.get(name, {}).get("p95", math.nan)) for name in columns]
        for source, found in sources.items()
    }
    table = {"95 of 100": list(columns.values())} | rows
    told = {
        source: "".join(f"{value:<{WIDTH}}" for value in values).rstrip()
        for source, values in table.items()
    }
    return labelled(told | trust(report))


def _validations(
    report: Mapping[str, Any],
) -> Iterator[tuple[str, Mapping[str, Any], Mapping[str, Any]]]:
    """Label, summary, and errors of the mesh of each kind of query at once."""
    kinds = {"errors": ("validation", "mesh_errors")}
    kinds |= {"tip's errors": ("validation_tip", "mesh_errors_tip")}
    for label, (kind, mesh) in kinds.items():
        if kind in report:
            yield label, report[kind], report["training"].get(mesh, {})


def closing(artifact: Path) -> list[str]:
    """What to know of an artifact just trained, and what to do next."""
    report = info(artifact)
    scene, example = parse_scene(report["text"]), report["loads"]["example"]
    tolerance, fineness = scene.tolerance, scene.geometry.fineness
    most = tolerance.reduction
    errors = [f"{label}: {text}" for label, text in accuracy(report).items()]
    found = report["validation"]
    if any(found[key]["p95"] > getattr(most, key) for key in ("displacement", "von_mises")):
        asked = f"{percent(most.displacement)} and {percent(most.von_mises)}"
        errors.append(
            f"this is more than the {asked} that the scene leaves the reduction; most errors are "
            "near the limits: a smaller load.max_indentation lowers them"
        )
    for label, found, mesh in _validations(report):
        over = [
            f"{COLUMNS[name]} {percent(mesh[name]['p95'])} (tolerance {percent(allowed)})"
            for name, allowed in tolerance.of("force" in found).total._asdict().items()
            if name in found and name in mesh and mesh[name]["p95"] > allowed
        ]
        if over:
            errors.append(
                f"{label}: the tolerance is missed by the mesh alone: {', '.join(over)}; answers "
                f"estimate it; geometry.{fineness} may be finer, and training takes longer then"
            )
    ways = {"at": f"--pressure {example['pressure']:.2g}", "tip": "--tip"}
    following = [
        f"next: palpate solve {artifact} --at {' '.join(f'{x:.4g}' for x in example[place])} {how}"
        for place, how in ways.items()
        if example[place]
    ]
    seconds = report["provenance"]["wall_seconds"]
    made = f"{artifact}: {report['bytes'] / 1e6:.1f} MB, made in {duration(seconds)}"
    return [made, *errors, *following]


def percent(share: float) -> str:
    """A share for people, a dash where there is none."""
    if math.isnan(share):
        return "–"
    if share > 10.0 or 0.0 < share < 1e-4:
        return "> 999 %" if share > 10.0 else "< 0.01 %"
    return f"{_digits(100 * share)} %"


def duration(seconds: float) -> str:
    """A time for people."""
    for most, unit, factor in ((1e-3, "µs", 1e6), (1.0, "ms", 1e3), (100.0, "s", 1.0)):
        if seconds < most:
            return f"{_digits(factor * seconds)} {unit}"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def _digits(value: float) -> str:
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def _tissue(scene: Scene) -> str:
    tissue = scene.tissue
    said: list[str] = [tissue.law]
    for key, field in type(tissue).model_fields.items():
        if isinstance(value := getattr(tissue, key), float):
            name, _, unit = (field.description or key).partition(", ")
            said.append(f"{name} {value:g} {unit}".rstrip())
    lost = sum(share for share, _ in tissue.prony)
    said.append(f"{percent(lost)} relaxes with time" if lost else "elastic")
    stiff = [f"{r.name} {r.young / tissue.young:.3g} times as stiff" for r in tissue.region]
    return ", ".join(said + stiff)
