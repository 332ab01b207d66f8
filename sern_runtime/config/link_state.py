"""The section of a client file about what it says at its site of its links and its peers."""

from typing import Annotated

from pydantic import Field

from sern_runtime.config.base import Seconds, Section


class LinkStateSection(Section):
    """What this site's nodes are told of the link: whether each client is there whose topics are taken here (a site's
    robots; the operator, at a robot). In the log, /readyz, /api/peers and the metrics it is in any case."""

    publish: bool | None = None
    """Publish, latched, a `diagnostic_msgs/DiagnosticStatus` of each on /NAME/sern/link, and one of the own link to the
    relay on /sern/link; null: where an endpoint is of ROS (`ros1`, `dds`, `zenoh`, `rclpy`); true: into a recording as
    well."""
    diagnostics: bool = True
    """Also publish all of them as one `diagnostic_msgs/DiagnosticArray` on /diagnostics."""
    period_s: Annotated[float, Field(ge=0.1, le=60)] = 1.0
    """How often they are published, those of clients that are given up once; a change at once."""
    withdraw_after_s: Seconds | None = None
    """The topics of a client that is not there end here after so long, and come back with it; null: they stay, with
    what is latched in them, until the relay gives the client up (`replay.resume_s` of the relay, 10 minutes)."""
