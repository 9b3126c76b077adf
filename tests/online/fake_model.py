"""A toy that answers like an `ReducedModel`: a block whose top dents linearly under the load."""

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from palpate.shared.errors import QueryError
from palpate.shared.geometry.surface import Surface
from palpate.shared.model import Solution
from palpate.shared.reduced.touch import Touch
from palpate.shared.scene import Scene, load_scene

QUICK = Path(__file__).parents[2] / "offline" / "scenes" / "quick.toml"


class Memory:
    """Where the tip was."""

    def __init__(self) -> None:
        self.last: np.ndarray | None = None
        self.gone_on = 0

    def forget(self) -> None:
        self.last = None
        self.gone_on = 0

    def go_on(self) -> None:
        self.gone_on += 1


class FakeModel:
    """A block of 10 x 10 x 5 mm, clamped below, pressed from above.

    Above `collapse` (kPa) it has no equilibrium; `poison` makes its answers NaN.

    A tip meets a bed of springs of `stiffness` (mN/mm). Deeper than `deepest` (mm) there is no
    equilibrium, but for a search that has gone on `snap` times; none is found more than `stride`
    (mm) from the last contact. Without `tips` there is no answer to a tip at all.
    """

    pressure_max = 8.0
    stiffness = 20.0
    deepest = 1.5
    stride = np.inf
    snap = 0
    tips: object | None = "a bed of springs"
    models = SimpleNamespace(viscous=None)

    def __init__(
        self, name: str = "toy", divisions: int = 10, collapse: float = 40.0, poison: bool = False
    ) -> None:
        scene = load_scene(QUICK)
        self.name = name
        self.scene: Scene = scene.model_copy(update={"name": name})
        self.info: dict[str, Any] = {"modes": 1, "validation": {"queries": 0}}
        self.collapse = collapse
        self.poison = poison
        axis = np.linspace(0.0, 10.0, divisions + 1)
        grid = np.stack(np.meshgrid(axis, axis, axis / 2, indexing="ij"), axis=-1)
        self.nodes = grid.reshape(-1, 3)
        self.clamped = self.nodes[:, 2] == 0.0
        self.surface_nodes = np.flatnonzero(self.nodes[:, 2] == 5.0).astype(np.int32)
        n = divisions + 1
        corner = (np.arange(divisions)[:, None] * n + np.arange(divisions)).ravel()
        first = np.stack([corner, corner + n, corner + n + 1], axis=1)
        second = np.stack([corner, corner + n + 1, corner + 1], axis=1)
        self.surface_triangles = np.concatenate([first, second]).astype(np.int32)
        top = self.nodes[self.surface_nodes]
        self.surface = Surface(top, self.surface_triangles, np.tile([0.0, 0.0, 1.0], (len(top), 1)))
        self.limits = np.full((len(top), 1), self.pressure_max)

    def solve(
        self,
        position: Any,
        pressure: float,
        direction: Any = None,
        radius: float | None = None,
        state: Any = None,
    ) -> Solution:
        start = time.perf_counter()
        position = np.asarray(position, float)
        contact = np.clip(position, [0, 0, 5], [10, 10, 5])
        distance = float(np.linalg.norm(position - contact))
        reach = self.scene.endoscope.reach
        if distance > reach:
            raise QueryError("position", f"{distance:.3g} mm from the surface; limit {reach} mm")
        normal = np.array([0.0, 0.0, 1.0])
        push = -normal if direction is None else np.asarray(direction, float)
        push = push / np.linalg.norm(push)
        if push @ normal >= 0:
            raise QueryError("direction", "90 degrees or more from the inward normal")
        usual = self.scene.endoscope.radius
        radius = usual if radius is None else radius
        out_of_range = ("pressure",) * (pressure > self.pressure_max)
        out_of_range += ("radius",) * (radius != usual)
        moved = 0.1 * pressure * push * (np.nan if self.poison else 1.0)
        return Solution(
            contact_point=contact,
            normal=normal,
            distance=distance,
            direction=push,
            tilt=float(np.degrees(np.arccos(-push @ normal))),
            departure=0.0,
            residual=0.0,
            pressure=pressure,
            radius=radius,
            pressure_limit=self.pressure_max,
            force=pressure * radius**2 * push,
            contact_displacement=moved,
            converged=pressure <= self.collapse,
            iterations=1,
            in_range=not out_of_range,
            out_of_range=out_of_range,
            error_displacement=0.001,
            error_von_mises=0.002,
            min_jacobian=1.0 - 0.01 * pressure,
            features=np.ones(1),
            patches=(),
            solve_seconds=time.perf_counter() - start,
        )

    def new_state(self) -> "Memory":
        return Memory()

    def touch(self, position: Any, state: Any = None, most: int = 40) -> Touch:
        start = time.perf_counter()
        if self.tips is None:
            raise QueryError("position", "no tip")
        state = self.new_state() if state is None else state
        position = np.array(position, float)
        radius = self.scene.endoscope.radius
        depth = float(5.0 + radius - position[2])
        if depth > radius:
            raise QueryError("position", "the tip's centre lies below the surface")
        last = state.last
        leap = last is not None and float(np.linalg.norm(position - last)) > self.stride
        snapped = 0 < self.snap <= state.gone_on
        converged = (depth <= self.deepest or snapped) and not leap
        if converged:
            state.last = position
        contact = depth > 0.0
        force = np.array([0.0, 0.0, self.stiffness * max(depth, 0.0)])
        tangent = np.diag([0.0, 0.0, -self.stiffness * contact])
        return Touch(
            position=position,
            contact=contact,
            force=force * (np.nan if self.poison else 1.0),
            tangent=tangent,
            contact_point=position - [0.0, 0.0, radius],
            normal=np.array([0.0, 0.0, 1.0]),
            depth=depth,
            depth_limit=1.0,
            penetration=0.01 * max(depth, 0.0),
            energy=0.5 * self.stiffness * max(depth, 0.0) ** 2,
            converged=converged,
            iterations=1,
            in_range=depth <= 1.0,
            out_of_range=("depth",) * (depth > 1.0),
            error_displacement=0.001,
            error_von_mises=0.002,
            error_force=0.003,
            min_jacobian=1.0 - 0.1 * max(depth, 0.0),
            features=np.ones(1),
            patches=((3, 1.0, np.array([depth, 0.5])),) * contact,
            solve_seconds=time.perf_counter() - start,
        )

    def _nodes(self, region: str) -> np.ndarray:
        return self.nodes[self.surface_nodes] if region == "surface" else self.nodes

    def _shape(self, solution: Solution | Touch, region: str) -> np.ndarray:
        nodes = self._nodes(region)
        squared = ((nodes - solution.contact_point) ** 2).sum(axis=1)
        width = self.scene.endoscope.radius
        return nodes[:, 2] / 5 * np.exp(-squared / (2 * width**2))

    def displacement(self, solution: Solution | Touch, region: str = "all") -> np.ndarray:
        if isinstance(solution, Touch):
            moved = np.array([0.0, 0.0, -max(solution.depth, 0.0)])
        else:
            moved = solution.contact_displacement
        return np.outer(self._shape(solution, region), moved).astype(np.float32)

    def von_mises(
        self,
        solution: Solution | Touch,
        region: str = "all",
        displacement: np.ndarray | None = None,
    ) -> np.ndarray:
        if isinstance(solution, Touch):
            pressure = float(np.linalg.norm(solution.force))
        else:
            pressure = solution.pressure
        return (pressure * self._shape(solution, region)).astype(np.float32)
