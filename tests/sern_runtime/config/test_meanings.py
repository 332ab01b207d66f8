"""What the keys of a section mean is read from its source, and from nothing else."""

from sern_runtime.config.meanings import meaning


class Lamp:
    """A lamp."""

    power_w: float
    """What it takes,
    at full brightness."""
    colour: str
    plugged: bool = True
    """Whether it is."""

    class Bulb:
        power_w: float
        """What it gives."""


class DeskLamp(Lamp):
    """Another."""

    plugged: bool = False
    height_m: float = 0.4
    """From the desk."""


def test_the_docstring_below_a_field_is_what_it_means() -> None:
    assert meaning(Lamp, "power_w") == "What it takes,\nat full brightness."
    assert meaning(Lamp, "colour") is None, "the next one's is not its own"
    assert meaning(Lamp, "plugged") == "Whether it is."
    assert meaning(Lamp, "height_m") is None
    assert meaning(Lamp.Bulb, "power_w") == "What it gives."


def test_a_field_means_what_the_class_says_that_declares_it_last() -> None:
    assert meaning(DeskLamp, "power_w") == meaning(Lamp, "power_w")
    assert meaning(DeskLamp, "plugged") is None
    assert meaning(DeskLamp, "height_m") == "From the desk."
