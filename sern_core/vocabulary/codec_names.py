"""Names of codecs and modes, and how much the lossy ones may lose."""

from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import Final


class Codec(IntEnum):
    """The codec byte of DATA_FIRST: how a body is encoded."""

    NONE = 0
    LZ4 = 1  # one LZ4 block
    ZSTD = 2  # one Zstandard frame, of any level
    DRACO = 3  # a point cloud, thinned; lossy
    JPEG = 4  # an image; lossy


class Compression(StrEnum):
    """The modes z of the paper's eq. (config_vector): what a sender may do with a body."""

    NONE = "none"
    LZ4 = "lz4"
    ZSTD = "zstd"
    ZSTD_STRONG = "zstd_strong"
    VOXEL_DRACO = "voxel_draco"  # lossy, for point clouds
    JPEG = "jpeg"  # lossy, for images


@dataclass(frozen=True, slots=True)
class LossyParams:
    """How much may be lost. `voxel_m`: edge of a voxel in metres; `jpeg_quality` from 1 to 95."""

    voxel_m: float = 0.1
    jpeg_quality: int = 75


DEFAULT_LOSSY: Final = LossyParams()
