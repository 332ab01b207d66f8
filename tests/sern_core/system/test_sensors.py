"""A scan, a camera and clouds that are thirty times what the link carries, over Wi-Fi with jitter and losses."""

from sern_core.summaries.spec import SummaryLevel
from tests.sensors import CAMERA, CLOUD, CLOUD_BYTES, SCAN, SETTLED_S, Sensors


def test_each_sensor_gets_through_and_clouds_as_their_summary() -> None:
    sensors = Sensors()
    sensors.world.run(SETTLED_S)
    assert sensors.clouds.fit.level is SummaryLevel.SUMMARY
    arrived = sensors.arrived(5.0)
    assert arrived[SCAN].rate_hz >= 7.8  # of 8; one may be under way at either end
    assert arrived[CAMERA].rate_hz >= 8.0 and arrived[CAMERA].age_s(0.99) <= 0.5
    assert arrived[CLOUD].rate_hz >= 10.0 and arrived[CLOUD].age_s(0.99) <= 0.5
    assert all(len(got.body) < CLOUD_BYTES for got in arrived[CLOUD].got)
    assert max(found.longest_gap_s for found in arrived.values()) <= 1.0
    assert sensors.clouds.fit.switches == 1
    sensors.world.validate()
