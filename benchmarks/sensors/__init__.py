"""A 2-D scan, a camera and clouds of 7.4 MB over Wi-Fi, as `tc netem` has it: SERN's installed daemons beside zenoh.

    sudo python -m benchmarks.sensors [--quick] [--systems ...] [--json FILE]

`bodies` are the messages, `ends` the processes at either end of the link, `figures` what a run amounts to.
"""
