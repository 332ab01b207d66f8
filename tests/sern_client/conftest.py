from tests.sern_client.endpoints.ros1.conftest import master

__all__ = ["master"]
