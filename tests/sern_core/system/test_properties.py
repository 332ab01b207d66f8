"""Random worlds: whatever links, relays and clients do, the delivery promises hold."""

from hypothesis import Phase, given, settings

from tests.exploring import cases
from tests.scenarios import Run, Scenario, scenarios
from tests.world import limited

PHASES = (Phase.explicit, Phase.generate)  # a scenario reads well as it is; making it smaller takes minutes


@settings(max_examples=cases(20), phases=PHASES)
@given(scenarios())
def test_promises_hold_in_any_world(scenario: Scenario) -> None:
    Run(scenario).play().check()


@settings(max_examples=cases(12), phases=PHASES)
@given(scenarios())
def test_promises_hold_when_work_goes_in_slices_everywhere(scenario: Scenario) -> None:
    """What is through in one slice in so small a world is cut after a message or two here."""
    Run(scenario, limited(slice_us=5)).play().check()
