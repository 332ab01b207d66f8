"""ROS 1 in plain asyncio: a node of a ROS master as an endpoint, without a ROS installation.

header, http, frames    bytes: connection headers, HTTP messages, TCPROS framing
xmlrpc, master, slave   XML-RPC both ways, the master's API, the node's own API
graph                   which nodes there are, what they offer, and whether they live
subscription            from local publishers to the link
publication, server     from the link to local subscribers
services                services, both ways
endpoint                all of it together: `Ros1Endpoint`
"""

from sern_client.endpoints.ros1.endpoint import Ros1Endpoint, Ros1Options

__all__ = ["Ros1Endpoint", "Ros1Options"]
