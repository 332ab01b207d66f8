"""Random worlds: whatever links, relays and clients do, the delivery promises hold."""

from hypothesis import HealthCheck, Phase, given, settings

from tests.scenarios import Run, Scenario, scenarios


@settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=30,
    phases=[Phase.explicit, Phase.generate],  # a scenario reads well as it is; making it smaller takes minutes
    suppress_health_check=[HealthCheck.too_slow],
)
@given(scenarios())
def test_promises_hold_in_any_world(scenario: Scenario) -> None:
    Run(scenario).play().check()
