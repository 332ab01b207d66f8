"""The configuration sections of the endpoints offer what the endpoints take, with the same defaults."""

from dataclasses import MISSING, fields

import pytest

from sern_client.endpoints.bag import BagOptions
from sern_client.endpoints.jackal import JACKAL
from sern_client.endpoints.record import RecordOptions
from sern_client.endpoints.ros1 import Ros1Options
from sern_client.endpoints.synthetic import SyntheticOptions
from sern_runtime.config.endpoints import (
    MAX_SYNTHETIC_TOPICS,
    BagEndpoint,
    EndpointBase,
    RecordEndpoint,
    Ros1Endpoint,
    SyntheticEndpoint,
)

PAIRS = [
    (BagEndpoint, BagOptions),
    (SyntheticEndpoint, SyntheticOptions),
    (RecordEndpoint, RecordOptions),
    (Ros1Endpoint, Ros1Options),
]


@pytest.mark.parametrize(("section", "options"), PAIRS, ids=lambda item: item.__name__)
def test_section_mirrors_options(section: type[EndpointBase], options: type[BagOptions]) -> None:
    settings = {name: field for name, field in section.model_fields.items() if name != "kind"}
    assert set(settings) == {field.name for field in fields(options)}
    for field in fields(options):
        # What must be chosen in a file may have a default in code.
        if field.default is not MISSING and not settings[field.name].is_required():
            assert settings[field.name].default == field.default, field.name


def test_as_many_topics_as_the_robot_has() -> None:
    assert len(JACKAL) == MAX_SYNTHETIC_TOPICS
