"""What one channel does with its bodies, and where one body stands."""

from collections.abc import Collection, Iterable
from enum import IntEnum
from typing import Final

from sern_core.bodies.codecs import LOSSLESS, CodecProfile, LossyTopic, quickest
from sern_core.vocabulary.codec_names import Compression
from sern_core.vocabulary.errors import UsageError

CHOOSE_INTERVAL_S: Final = 0.1
"""How long a choice of `auto` stands."""
RATIO_GAIN: Final = 0.2


class Coding(IntEnum):
    """Where one body stands."""

    RAW = 0  # nobody has looked at it yet
    HELD = 1  # chosen, and waits for its turn to be encoded
    RUNNING = 2  # another thread encodes it
    DONE = 3  # goes as it is now


def preferred(codecs: Iterable[Compression], allowed: Collection[Compression]) -> Compression:
    """The first of `codecs` that a topic allows; `none`, which all of them do, if there is no other."""
    return next((codec for codec in codecs if codec in allowed), Compression.NONE)


class ChannelCodec:
    """What one channel does with its bodies, and what it found out about them."""

    __slots__ = (
        "due_s",
        "encoded_bytes",
        "messages_to_probe",
        "mode",
        "modes",
        "probing",
        "profiles",
        "ratio",
        "raw_bytes",
        "setting",
        "topic",
    )

    def __init__(self, setting: Compression | None, topic: LossyTopic | None = None) -> None:
        self.topic = topic
        """The lossy modes that are allowed; None: none."""
        self.modes = LOSSLESS[1:] if topic is None else (*LOSSLESS[1:], *topic.modes)
        """What there is to choose from, beside `none`."""
        self.setting = setting
        """The mode to use; None: whichever is quickest (`auto`)."""
        self.mode = setting or Compression.NONE
        """The mode in use."""
        self.profiles: dict[Compression, CodecProfile] = {}
        """What each mode makes of this topic, as measured; empty before the first message."""
        self.ratio = 1.0
        """What becomes of a body, by bytes, in recent messages: what is left of one that is not encoded yet."""
        self.raw_bytes = 0
        self.encoded_bytes = 0
        """Bytes of all messages chosen so far, before and after, those that went as they were included."""
        self.messages_to_probe = 0
        self.probing = False
        self.due_s = -float("inf")

    def choose(self, nbytes: int, rate_bps: float | None, now: float) -> Compression:
        """The mode for a body of `nbytes`. On a link that has never been full (rate None) nothing is to be gained."""
        if now >= self.due_s:
            self.due_s = now + CHOOSE_INTERVAL_S
            if self.setting is not None:
                self.mode = self.setting
            elif rate_bps:
                self.mode = quickest(self.profiles, self.modes, nbytes, rate_bps / 8)
            else:
                self.mode = Compression.NONE
        return self.mode

    def use(self, setting: Compression | None) -> None:
        """Another mode from the next body on. UsageError for a lossy one that the topic does not allow."""
        if setting is not None and setting is not Compression.NONE and setting not in self.modes:
            raise UsageError(f"{setting} loses something, and the topic does not allow it (`lossy`)")
        self.setting = setting
        self.due_s = -float("inf")
        if setting is not None:
            self.mode = setting
            profile = self.profiles.get(setting)
            if setting is Compression.NONE:
                self.ratio = 1.0
            elif profile is not None:
                self.ratio = min(1.0, profile.ratio)

    def measured(self, raw_bytes: int, encoded_bytes: int) -> None:
        """A body went from `raw_bytes` to `encoded_bytes`."""
        self.raw_bytes += raw_bytes
        self.encoded_bytes += encoded_bytes
        self.ratio += RATIO_GAIN * (encoded_bytes / raw_bytes - self.ratio)
