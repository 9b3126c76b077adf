"""The rigid tip on the reduced model: what is answered, what is flagged, what is refused."""

import math

import numpy as np
import pytest

from shared.atlas import Atlas
from shared.errors import QueryError


@pytest.fixture(scope="module")
def atlas(artifact):
    return Atlas.load(artifact)


def above(atlas, depth, at=(0.5, 0.5)):
    """A tip's centre over the flat top, so deep in it."""
    top = atlas.nodes.max(axis=0)
    return np.array([at[0] * top[0], at[1] * top[1], top[2] + atlas.scene.endoscope.radius - depth])


def test_a_tip_off_the_surface_feels_nothing(atlas):
    answer = atlas.touch(above(atlas, -0.5))
    assert not answer.contact
    assert answer.converged
    assert not answer.force.any()
    assert not answer.tangent.any()
    assert answer.patches == ()
    assert answer.depth == pytest.approx(-0.5)
    assert not atlas.displacement(answer).any()


def test_the_tool_is_pushed_back(atlas):
    answer = atlas.touch(above(atlas, 0.4))
    assert answer.contact
    assert answer.converged
    assert answer.depth == pytest.approx(0.4)
    assert answer.force[2] > 0.0
    assert answer.tangent[2, 2] < 0.0
    assert abs(answer.force[:2]).max() < 0.05 * answer.force[2]
    assert 0 < answer.penetration < 0.02 * answer.depth
    assert atlas.displacement(answer)[:, 2].min() == pytest.approx(-0.4, abs=0.1)


@pytest.mark.parametrize("position", [[math.nan, 0, 0], [0, math.inf, 0], [1.0, 2.0], "here"])
def test_what_is_no_position_is_refused(atlas, position):
    with pytest.raises(QueryError) as refused:
        atlas.touch(position)
    assert refused.value.field == "position"


def test_a_tip_inside_the_body_is_refused(atlas):
    with pytest.raises(QueryError, match="below the surface"):
        atlas.touch(above(atlas, 2.1))
