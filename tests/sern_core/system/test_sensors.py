"""A scan, a camera and clouds that are thirty times what the link carries, over Wi-Fi with jitter and losses."""

import pytest

from sern_core.summaries.spec import SummaryLevel
from tests.exploring import also
from tests.sensors import CAMERA, CLOUD, CLOUD_BYTES, SCAN, SETTLED_S, Sensors


@pytest.mark.parametrize("seed", [1, 6, *also(3, 7)])
def test_each_sensor_gets_through_and_clouds_as_their_summary(seed: int) -> None:
    sensors = Sensors(seed=seed)
    sensors.world.run(SETTLED_S)
    assert sensors.clouds.fit.level is SummaryLevel.SUMMARY
    arrived = sensors.arrived(10.0)
    assert arrived[SCAN].rate_hz >= 7.5  # of 8; one that lost a fragment is not sent again when the next one is there
    assert arrived[CAMERA].rate_hz >= 8.0 and arrived[CAMERA].age_s(0.99) <= 0.5
    assert arrived[CLOUD].rate_hz >= 9.5 and arrived[CLOUD].age_s(0.99) <= 0.5
    assert all(len(got.body) < CLOUD_BYTES for got in arrived[CLOUD].got)
    assert max(found.longest_gap_s for found in arrived.values()) <= 1.0
    assert sensors.clouds.fit.switches == 1
    sensors.world.validate()
