"""Random worlds: whatever links, relays and clients do, the delivery promises hold."""

from hypothesis import Phase, given, settings

from tests.exploring import cases
from tests.scenarios import Run, Scenario, scenarios


@settings(
    max_examples=cases(30),
    phases=[Phase.explicit, Phase.generate],  # a scenario reads well as it is; making it smaller takes minutes
)
@given(scenarios())
def test_promises_hold_in_any_world(scenario: Scenario) -> None:
    Run(scenario).play().check()
