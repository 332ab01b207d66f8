"""A ROS 2 node over zenoh that is not ours: zenoh-ros2-sdk, told what to do by lines of JSON on standard input.

It answers each line with one, and says what arrives in lines of its own. Ends with its standard input.
"""

import json
import sys
import threading
from typing import Any

from zenoh_ros2_sdk import ROS2Publisher, ROS2ServiceClient, ROS2ServiceServer, ROS2Subscriber
from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability
from zenoh_ros2_sdk.session import ZenohSession

STRING = "std_msgs/msg/String"
STRING_TEXT = "string data\n"
SERVICE = "std_srvs/srv/SetBool"
REQUEST_TEXT = "bool data\n"
RESPONSE_TEXT = "bool success\nstring message\n"
_lock = threading.Lock()


def say(**fields: Any) -> None:
    with _lock:
        print(json.dumps(fields), flush=True)


def qos(order: dict[str, Any]) -> QosProfile:
    return QosProfile(
        reliability=QosReliability.BEST_EFFORT if order.get("best_effort") else QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if order.get("latched") else QosDurability.VOLATILE,
        history_depth=order.get("depth", 10),
    )


class Peer:
    def __init__(self, port: int, domain: int) -> None:
        self.where = {"router_ip": "127.0.0.1", "router_port": port, "domain_id": domain}
        self.things: dict[str, Any] = {}

    def obey(self, order: dict[str, Any]) -> dict[str, Any]:
        match order["do"]:
            case "publisher":
                definition = order.get("definition", STRING_TEXT)
                kind = order.get("type", STRING)
                thing = ROS2Publisher(
                    order["name"], kind, definition, type_hash=order.get("hash"), qos=qos(order), **self.where
                )
                self.things["pub" + order["name"] + order.get("type", "")] = thing
                return {"hash": thing.type_hash}
            case "publish":
                self.things["pub" + order["name"]].publish(data=order["data"])
            case "subscriber":
                name = order["name"]
                self.things["sub" + name] = ROS2Subscriber(
                    name, STRING, lambda message: say(got=name, data=message.data), STRING_TEXT, qos=qos(order),
                    **self.where,
                )  # fmt: skip
            case "server":
                server = ROS2ServiceServer(
                    order["name"], SERVICE, lambda request: reply(not request.data), REQUEST_TEXT, RESPONSE_TEXT,
                    **self.where,
                )  # fmt: skip

                def reply(success: bool) -> Any:
                    return server.response_msg_class(success=success, message="as you say")

                self.things["server" + order["name"]] = server
                return {"hash": server.type_hash}
            case "call":
                client = ROS2ServiceClient(
                    order["name"],
                    SERVICE,
                    REQUEST_TEXT,
                    RESPONSE_TEXT,
                    type_hash=order["hash"],
                    timeout=60,
                    **self.where,
                )
                response = client.call(data=order["data"])
                client.close()
                return {"answer": None if response is None else [response.success, response.message]}
            case "sees":
                found = ZenohSession.get_instance().liveliness.get(f"@ros2_lv/**/{order['kind']}/**", timeout=60)
                return {"sees": any(reply.ok and f"/{order['name']}/" in str(reply.ok.key_expr) for reply in found)}
            case "close":
                self.things.pop(order["thing"]).close()
        return {}

    def end(self) -> None:
        for thing in self.things.values():
            thing.close()
        ZenohSession.get_instance().close()


def main() -> None:
    peer = Peer(int(sys.argv[1]), int(sys.argv[2]))
    try:
        for line in sys.stdin:
            say(done=True, **peer.obey(json.loads(line)))
    finally:
        peer.end()


if __name__ == "__main__":
    main()
