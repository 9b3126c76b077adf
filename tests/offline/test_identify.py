"""Young's modulus from measured forces, beside forces that are made with a known one."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from palpate.offline.commands import identify
from palpate.offline.identify import CONFIDENCE, slope
from palpate.offline.run.tables import write_csv
from palpate.offline.validate.queries import random_positions
from palpate.shared.reduced.transfer import REST

NOISE = 0.05
"""Of each component, over the size of the force."""


def noisy(forces, rng):
    """Forces (n, 3) with noise."""
    size = np.linalg.norm(forces, axis=1, keepdims=True)
    return forces + NOISE * size * rng.standard_normal(forces.shape)


def recorded(path, at, forces, **more):
    """Write positions and forces; each further column by its name."""
    names = "x", "y", "z", "force_x", "force_y", "force_z"
    table = np.hstack([at, forces])
    write_csv(
        path,
        [
            dict(zip(names, row, strict=True)) | {name: column[i] for name, column in more.items()}
            for i, row in enumerate(table)
        ],
    )
    return path


def identified(*arguments):
    """Report of the command."""
    result = CliRunner().invoke(identify, [*map(str, arguments), "--json"])
    assert result.exit_code == 0, result.output
    return json.loads(result.output)


def test_the_true_modulus_lies_in_the_interval(atlas, rng):
    """In 100 recordings of 30 forces: 95 % of a binomial law are within 90 and 99."""
    at = np.array([step.position for step in random_positions(atlas, 3000, rng)])
    found = atlas.touch_many(at)
    held = 0
    for part in np.arange(3000).reshape(100, 30):
        used = found.in_range[part] & (np.linalg.norm(found.force[part], axis=1) > 0.0)
        forces, true = found.force[part][used], rng.uniform(3.0, 60.0) / atlas.scene.tissue.young
        ratio, half = slope(forces, noisy(true * forces, rng))
        held += abs(ratio - true) < half
        assert half < 0.06 * true
    assert 90 <= held <= 100
    assert CONFIDENCE == 0.95


def test_a_recording_tells_the_modulus(artifact, atlas, rng, tmp_path):
    """Rows without contact, beyond the range or without a measured force are left aside."""
    at = np.array([step.position for step in random_positions(atlas, 40, rng)])
    forces = atlas.touch_many(at, young=24.0).force
    used = atlas.touch_many(at).in_range & (np.linalg.norm(forces, axis=1) > 0.0)
    at = np.vstack([at, at[0] + [0.0, 0.0, 3.0]])
    report = identified(
        artifact, recorded(tmp_path / "a.csv", at, np.vstack([forces, np.zeros(3)]))
    )
    assert report["young"] == pytest.approx(24.0, rel=1e-6)
    low, high = report["interval"]
    assert low <= report["young"] <= high
    assert high - low < 1e-3
    assert report["used"] == used.sum() >= 30
    assert report["rows"] == 41
    assert 0.0 < report["error_force"] < 0.5


def test_the_past_counts(visco_artifact, visco_atlas, rng, tmp_path):
    middle = visco_atlas.nodes.max(axis=0) * [0.5, 0.5, 1.0]
    times = np.linspace(0.0, 0.5, 20)
    at = middle + np.outer(visco_atlas.body.tip.radius - 0.3 * np.sqrt(times), [0.0, 0.0, 1.0])
    forces, past, warm = [], REST, visco_atlas.new_warm()  # as the command asks, to the same bits
    for x, dt in zip(at, np.diff(times, prepend=0.0), strict=True):
        answer = visco_atlas.touch(x, young=30.0, past=past, dt=dt, warm=warm)
        forces.append(answer.force)
        past = answer.past
    path = recorded(tmp_path / "a.csv", at, np.array(forces), time=times)
    assert identified(visco_artifact, path)["young"] == pytest.approx(30.0, rel=1e-6)


WRONG = {
    "x,y,z\n1,2,3\n": "lacks force_x, force_y, force_z",
    "x,y,z,force_x,force_y,force_z\n1,2,3,4,5\n": "line 2: must be 6 numbers",
    "x,y,z,force_x,force_y,force_z\n5,5,99,0,0,1\n": "0 rows are in contact",
    "x,y,z,force_x,force_y,force_z\n5,5,nan,0,0,1\n": "positions.0: must be finite",
}


@pytest.mark.parametrize("text", WRONG)
def test_what_is_no_recording_is_refused(artifact, tmp_path, text):
    path = tmp_path / "a.csv"
    path.write_text(text)
    result = CliRunner().invoke(identify, [str(artifact), str(path)])
    assert result.exit_code
    assert WRONG[text] in f"{result.output}{result.exception}"
