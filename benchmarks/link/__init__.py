"""One robot, one degraded link, one site: SERN beside plain ZeroMQ and zenoh on the same real `tc netem`.

    sudo python -m benchmarks.link [--quick] [--cases ...] [--systems ...] [--json FILE] [--plots DIR] [--traces DIR]

`load` is what is offered and how it is recorded, `end` the process at either end of the link, `sern` and `peers` the
systems inside it, `forwarder` the floor of a relay's CPU, `children` the processes of a run, `runs` one run in the lab,
`figures` what a run amounts to, `plots` its pictures, `cases` the cases and the figures that the project set out to
keep.
"""
