"""Random worlds: whatever links, relays and clients do, the delivery promises hold."""

import pytest
from hypothesis import Phase, given, settings

from sern_core.link import reading, receiver, streams_in
from sern_core.relay import hub_fanout
from sern_core.stream import in_stream
from tests.exploring import cases
from tests.scenarios import Run, Scenario, scenarios

PHASES = (Phase.explicit, Phase.generate)  # a scenario reads well as it is; making it smaller takes minutes
SLICED = (in_stream, receiver, reading, streams_in, hub_fanout)
"""Every module that ends a slice."""


@settings(max_examples=cases(30), phases=PHASES)
@given(scenarios())
def test_promises_hold_in_any_world(scenario: Scenario) -> None:
    Run(scenario).play().check()


@settings(max_examples=cases(25), phases=PHASES)
@given(scenarios())
def test_promises_hold_when_work_goes_in_slices_everywhere(scenario: Scenario) -> None:
    """What is through in one slice in so small a world is cut after a message or two here."""
    with pytest.MonkeyPatch.context() as patch:
        for module in SLICED:
            patch.setattr(module, "SLICE_US", 5)
        Run(scenario).play().check()
