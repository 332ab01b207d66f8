"""The lab: a degraded link between network namespaces, made by the kernel's own `tc netem`.

    from sern_tools.lab.lab import Lab

    with Lab() as lab:
        lab.apply(load_profile("field-wifi"))
        lab.exec(lab.a, ["ping", "-c", "3", lab.b.address])

Modules, each importing only those before it: `host` (namespaces of this machine), `removal` and `keeper` (what removes
them again, whatever happened to their owner), `image` and `appliance` (the guest that runs netem where this kernel
cannot), `backends`, `passing` (whether datagrams get through), `lab`, and `control` and `cli` for `sern lab`. Nothing
is imported here, so that the keeper is a small process.
"""
