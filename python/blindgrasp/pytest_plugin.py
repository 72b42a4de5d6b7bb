"""A fixture of pytest that replays recordings through a graph, so that a test says what is decided.

    def test_mugs(replay):
        decisions = replay("mugs.mcap", "../dataflow.yaml", set={"lift_arbiter.votes": 2})
        assert decisions[3].action == "lift"
        assert decisions.false_positives == 0

Where the package is installed, pytest loads this module by itself.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import pytest

from ._graph import ReplayedDecisions, replay_in


@pytest.fixture
def replay(request: pytest.FixtureRequest) -> Callable[..., ReplayedDecisions]:
    """`blindgrasp.replay`, with relative paths from the folder of the test's file."""
    return functools.partial(replay_in, request.path.parent)
