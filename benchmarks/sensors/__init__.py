"""A 2-D scan, a camera and clouds of 7.4 MB over Wi-Fi, as `tc netem` has it: SERN's installed daemons beside zenoh.

    sudo python -m benchmarks.sensors [--quick] [--systems ...] [--json FILE]

`bodies` are the messages, `ends` the processes at either end of the link, `figures` what a run amounts to.
"""

from typing import Final

from sern_sim.models import LinkModel

WIFI: Final = LinkModel(
    rate_bps=25e6,
    delay_s=0.020,
    jitter_s=0.010,
    rate_after_jitter=True,
    loss=0.005,
    reorder=0.01,
    duplicate=0.001,
    queue_packets=1000,
)
"""What all of them go over, in the lab and in virtual time."""
