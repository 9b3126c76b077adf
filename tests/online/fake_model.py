"""A toy that answers like a `ReducedModel`: a block whose top dents linearly under the load."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from palpate.shared.answer import Answer, Answers, peak
from palpate.shared.errors import QueryError
from palpate.shared.fields import Composition
from palpate.shared.geometry.surface import Surface
from palpate.shared.mechanics.footprint import LIMIT_FIELDS, TIP_DEPTH
from palpate.shared.query import ABSURD, rows, stiffness
from palpate.shared.reduced.transfer import Past
from palpate.shared.scene import load_scene

QUICK = Path(__file__).parents[2] / "offline" / "scenes" / "quick.toml"
UP = np.array([0.0, 0.0, 1.0])
DEEPEST_TRAINED = 1.0


class Memory:
    """Where the tip was."""

    last: np.ndarray | None = None

    def forget(self) -> None:
        vars(self).clear()


def _answers(answers: list[Answer]) -> Answers:
    names = set(Answers._fields) - {"limit"}
    found = {name: np.array([getattr(answer, name) for answer in answers]) for name in names}
    return Answers(**found, limit=np.ones(len(answers)))


class FakeModel:
    """A block of 10 x 10 x 5 mm, clamped below, pressed from above.

    Above `collapse` (kPa) it has no equilibrium; `poison` makes its answers NaN.

    A tip meets a bed of springs of `stiffness` (mN/mm). Deeper than `deepest` (mm) there is no
    equilibrium; none is found more than `stride` (mm) from the last contact. Without `has_tip`
    there is no answer to a tip at all. With `in_time` the force grows with the time since rest, and
    `steps` are those that were taken.
    """

    pressure_max = 8.0
    collapse = 40.0
    poison = False
    stiffness = 20.0
    deepest = 1.5
    stride = np.inf
    has_tip = True
    models = SimpleNamespace(viscous=None, region=np.zeros(4, int), centres=np.zeros((4, 3)))
    seal = "5ea1"

    def __init__(
        self, name: str = "toy", divisions: int = 10, in_time: bool = False, **changes: Any
    ) -> None:
        vars(self).update(changes)
        scene = load_scene(QUICK)
        tissue = scene.tissue.model_copy(update={"prony": ((0.5, 0.1),) if in_time else ()})
        self.name = name
        self.scene = scene.model_copy(update={"name": name, "tissue": tissue})
        self.info: dict[str, Any] = {
            "modes": 1,
            "training": {"seconds": {}},
            "validation": {"queries": 0},
        }
        self.steps: list[float] = []
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
        self.surface = Surface(top, self.surface_triangles, np.tile(UP, (len(top), 1)))
        self.limits = np.full((len(top), LIMIT_FIELDS), self.pressure_max)
        self.limits[:, TIP_DEPTH] = DEEPEST_TRAINED

    def press(
        self, position: Any, pressure: float, direction: Any = None, radius: float | None = None,
        *, young: float | None = None, **time: Any,
    ) -> Answer:  # fmt: skip
        ratio = stiffness(self.scene.tissue.young, young)
        return self._press(position, pressure / ratio, direction, radius, **time).stiffened(ratio)

    def _press(
        self, position: Any, pressure: float, direction: Any, radius: float | None,
        past: Past | None = None, dt: float = 0.0, warm: Memory | None = None,
    ) -> Answer:  # fmt: skip
        if position is None:
            position, pressure = (5.0, 5.0, 5.0), 0.0
        if pressure > ABSURD * self.pressure_max:
            raise QueryError("pressure", f"must be at most {ABSURD * self.pressure_max} kPa")
        contact = np.clip(position, [0, 0, 5], [10, 10, 5])
        distance = float(np.linalg.norm(position - contact))
        reach, usual = self.scene.endoscope.reach, self.scene.endoscope.radius
        if distance > reach:
            raise QueryError("position", f"{distance:.3g} mm from the surface; limit {reach} mm")
        push = -UP if direction is None else np.asarray(direction, float)
        push = push / (np.linalg.norm(push) or 1.0)
        if push @ UP > -1e-9:
            raise QueryError("direction", "90 degrees or more from the inward normal")
        radius = usual if radius is None else radius
        out_of_range = ("pressure",) * (pressure > self.pressure_max)
        out_of_range += ("radius",) * (radius != usual)
        return Answer(
            contact_point=contact,
            normal=UP,
            distance=distance,
            direction=push,
            pressure=pressure,
            radius=radius,
            pressure_limit=self.pressure_max,
            force=-pressure * radius**2 * push,
            contact_displacement=0.1 * pressure * push * (np.nan if self.poison else 1.0),
            converged=pressure <= self.collapse,
            iterations=1,
            in_range=not out_of_range,
            out_of_range=out_of_range,
            error_displacement=np.inf if out_of_range else 0.001,
            error_von_mises=np.inf if out_of_range else 0.002,
            min_jacobian=1.0 - 0.01 * pressure,
            past=None if past is None else past._replace(time=past.time + dt),
            time=0.0 if past is None else past.time + dt,
        )

    def new_warm(self) -> Memory:
        return Memory()

    def touch(self, position: Any, *, young: float | None = None, **time: Any) -> Answer:
        ratio = stiffness(self.scene.tissue.young, young)
        return self._touch(position, **time).stiffened(ratio)

    def _touch(
        self, position: Any, past: Past | None = None, dt: float = 0.0,
        warm: Memory | None = None,
    ) -> Answer:  # fmt: skip
        if not self.has_tip:
            raise QueryError("position", "no tip")
        if past is not None:
            self.steps.append(dt)
        state = warm or Memory()
        position = np.array(position, float)
        radius = self.scene.endoscope.radius
        depth = float(5.0 + radius - position[2])
        if depth > radius:
            raise QueryError("position", "the tip's centre lies below the surface")
        leap = state.last is not None and np.linalg.norm(position - state.last) > self.stride
        converged = depth <= self.deepest and not leap
        if converged:
            state.last = position
        contact, pressed = depth > 0.0, max(depth, 0.0)
        time = 0.0 if past is None else past.time + dt
        after = None if past is None else past._replace(time=time, position=position)
        return Answer(
            tip=True,
            position=position,
            contact=contact,
            force=(1.0 + time) * self.stiffness * pressed * UP * (np.nan if self.poison else 1.0),
            tangent=np.diag(-self.stiffness * contact * UP),
            contact_point=position - radius * UP,
            normal=UP,
            depth=depth,
            depth_limit=DEEPEST_TRAINED,
            penetration=0.01 * pressed,
            energy=0.5 * self.stiffness * pressed**2,
            converged=converged,
            iterations=1,
            in_range=depth <= DEEPEST_TRAINED,
            out_of_range=("depth",) * (depth > DEEPEST_TRAINED),
            error_displacement=0.001,
            error_von_mises=0.002,
            error_force=0.003,
            min_jacobian=1.0 - 0.1 * pressed,
            parts=((3, 1.0, np.array([depth, 0.5])),) * contact,
            time=time,
            past=after if converged else past,
        )

    def check(self, **load: Any) -> tuple[float, tuple[str, ...]]:
        answer = self.press(**load)
        return answer.pressure_limit, answer.out_of_range

    def solve_many(
        self, positions: Any, pressures: Any, directions: Any = None, young: float | None = None
    ) -> Answers:
        at = rows("positions", positions, 3)
        pressed = rows("pressures", pressures, 1, len(at))[:, 0]
        along = (
            [None] * len(at) if directions is None else rows("directions", directions, 3, len(at))
        )
        return _answers(
            [
                self.press(*load, young=young)
                for load in zip(at, pressed.tolist(), along, strict=True)
            ]
        )

    def touch_many(self, positions: Any, young: float | None = None) -> Answers:
        return _answers([self.touch(x, young=young) for x in rows("positions", positions, 3)])

    def _field(self, value: Any, answer: Answer, region: str) -> np.ndarray:
        """Fade a value at the contact point away with the distance and towards the bottom."""
        nodes = self.nodes[self.surface_nodes] if region == "surface" else self.nodes
        squared = ((nodes - answer.contact_point) ** 2).sum(axis=1)
        shape = nodes[:, 2] / 5 * np.exp(-squared / (2 * self.scene.endoscope.radius**2))
        return np.multiply.outer(shape, value).astype(np.float32)

    def displacement(self, answer: Answer, region: str = "all") -> np.ndarray:
        moved = -max(answer.depth, 0.0) * UP if answer.tip else answer.contact_displacement
        return self._field(moved, answer, region)

    def surface_modes(self, number: int) -> np.ndarray:
        x, y, _ = self.nodes[self.surface_nodes].T
        return np.stack([np.outer(x, UP), np.outer(y, UP)], axis=1).astype(np.float32)

    def composition(self, answer: Answer) -> Composition:
        states = np.array([q for _, _, q in answer.parts], np.float32).reshape(-1, 2)
        moved = self.displacement(answer, "surface")
        models = np.full(len(states), 3, np.int32)
        return Composition(models, states, np.arange(len(moved), dtype=np.int32), moved)

    def peaks(self, answer: Answer, displacement: np.ndarray) -> tuple[float, float]:
        stress = self.von_mises(answer)
        return float(stress.max()), float(np.percentile(stress, 99))

    def peak(self, answer: Answer, displacement: np.ndarray) -> dict[str, Any]:
        return peak(displacement, [self.peaks(answer, displacement)], [])

    def von_mises(
        self, answer: Answer, region: str = "all", displacement: Any = None
    ) -> np.ndarray:
        return self._field(np.linalg.norm(answer.force), answer, region)
