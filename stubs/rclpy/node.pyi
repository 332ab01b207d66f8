from collections.abc import Callable
from typing import Any

from rclpy.context import Context
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

class Node:
    def __init__(
        self,
        node_name: str,
        *,
        context: Context | None = None,
        namespace: str | None = None,
        enable_rosout: bool = True,
        start_parameter_services: bool = True,
    ) -> None: ...
    def get_name(self) -> str: ...
    def get_namespace(self) -> str: ...
    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]: ...
    def get_publishers_info_by_topic(self, topic_name: str, no_mangle: bool = False) -> list[TopicEndpointInfo]: ...
    def create_publisher(self, msg_type: type[Any], topic: str, qos_profile: QoSProfile | int) -> Publisher: ...
    def create_subscription(
        self,
        msg_type: type[Any],
        topic: str,
        callback: Callable[[bytes], None],
        qos_profile: QoSProfile | int,
        *,
        raw: bool = False,
    ) -> Subscription: ...
    def destroy_publisher(self, publisher: Publisher) -> bool: ...
    def destroy_subscription(self, subscription: Subscription) -> bool: ...
    def destroy_node(self) -> None: ...
