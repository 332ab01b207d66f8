"""The guest's kernel and initramfs: a kernel of this machine that has netem, busybox, and the real `tc` and `ip`.

The archive is built once for a kernel into the user's cache and takes well under a second; anything it was built from
having changed makes another.
"""

import gzip
import lzma
import os
import re
import shutil
import stat
import subprocess
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sern_tools.lab.host import LabError, run, search_path

KERNEL_PACKAGE: Final = "linux-image-cloud-amd64"
MODULES: Final = ("virtio_pci", "virtio_net", "bridge", "sch_netem", "sch_tbf", "veth")
"""What the guest needs; `modules.dep` says what these need in turn. veth lets the guest try the native lab out."""
READY: Final = "@ready"
FAILED: Final = "@failed"
END: Final = "@end"
"""Lines of the guest: it has booted; it cannot; a command has ended, with its exit status behind it."""

_INIT: Final = f"""#!/bin/busybox sh
export PATH=/sbin:/bin
/bin/busybox --install -s /bin
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
mkdir -p /run/netns
mount -t tmpfs run /run
stty -echo
echo 1 > /proc/sys/kernel/printk
while read -r module; do
    insmod "/modules/$module" || echo "{FAILED} module $module"
done < /modules/order
for scope in all default; do
    [ ! -e /proc/sys/net/ipv6 ] || echo 1 > /proc/sys/net/ipv6/conf/$scope/disable_ipv6
done
/sbin/ip link set lo up
/sbin/ip link add br0 type bridge forward_delay 0 mcast_snooping 0 || echo "{FAILED} no bridge"
/sbin/ip link set br0 up
for port in eth0 eth1; do
    # Packets that were merged on arrival would be delayed, lost and queued as one.
    /sbin/ip link set $port gro_max_size 1 || echo "{FAILED} cannot turn off the merging of packets on $port"
    /sbin/ip link set $port up || echo "{FAILED} no $port"
done
for port in eth0 eth1; do
    # A port that joins before its carrier is known may stay disabled, so it joins until it forwards (state 3).
    tries=0
    until [ "$(cat /sys/class/net/br0/brif/$port/state 2>/dev/null)" = 3 ]; do
        [ $tries -lt 500 ] || {{ echo "{FAILED} $port does not forward"; break; }}
        tries=$((tries + 1))
        usleep 10000
        /sbin/ip link set $port nomaster
        [ "$(cat /sys/class/net/$port/carrier)" != 1 ] || /sbin/ip link set $port master br0
    done
done
echo "{READY} $(uname -r)"
while IFS= read -r line; do
    eval "$line" 2>&1
    echo "{END} $?"
done
"""


@dataclass(frozen=True)
class Kernel:
    """A kernel with its modules, in the order in which they load (built-in ones left out)."""

    version: str
    image: Path
    modules: tuple[Path, ...]


def find_kernel(boot: Path = Path("/boot"), library: Path = Path("/lib/modules")) -> Kernel:
    """The newest kernel of this machine that has what the guest needs, cloud kernels first. LabError when none has."""
    reasons = []
    images = sorted(boot.glob("vmlinuz-*"), key=lambda path: ("cloud" in path.name, _natural(path.name)), reverse=True)
    for image in images:
        version = image.name.removeprefix("vmlinuz-")
        try:
            return Kernel(version, image, modules_of(library / version))
        except LabError as error:
            reasons.append(str(error))
    why = f" ({'; '.join(reasons)})" if reasons else ""
    raise LabError(f"no kernel with netem in {boot}{why}: apt-get install {KERNEL_PACKAGE}")


def _natural(text: str) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", text)]


def modules_of(directory: Path, wanted: Iterable[str] = MODULES) -> tuple[Path, ...]:
    """The module files for `wanted` below /lib/modules/VERSION, each after those it needs. LabError when one lacks."""
    try:
        needs = dict(_dependencies((directory / "modules.dep").read_text(encoding="utf-8")))
        builtin = {_module(line) for line in (directory / "modules.builtin").read_text(encoding="utf-8").split()}
    except OSError as error:
        raise LabError(f"{error.filename}: {error.strerror}") from error
    paths = {_module(path): path for path in needs}
    order: dict[str, None] = {}
    for name in wanted:
        if name in builtin:
            continue
        if name not in paths:
            raise LabError(f"{directory.name} has no {name}")
        # modules.dep lists everything that is needed, directly or not, what loads first last.
        order.update(dict.fromkeys((*reversed(needs[paths[name]]), paths[name])))
    return tuple(directory / path for path in order)


def _dependencies(text: str) -> Iterator[tuple[str, list[str]]]:
    for line in text.splitlines():
        path, _, needs = line.partition(":")
        yield path, needs.split()


def _module(path: str) -> str:
    return Path(path).name.partition(".ko")[0].replace("-", "_")


def cached_image(kernel: Kernel) -> Path:
    """The initramfs for a kernel, built unless it is in the cache. LabError names the package that is missing."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sern/lab"
    content = _contents(kernel)
    mark = zlib.crc32(repr([_mark(name, source) for name, source in content.items()]).encode())
    path = cache / f"initramfs-{kernel.version}-{mark:08x}.cpio"
    if path.is_file():
        return path
    try:
        cache.mkdir(parents=True, exist_ok=True)
        temporary = path.with_suffix(f".{os.getpid()}")
        try:
            temporary.write_bytes(archive({name: _read(source) for name, source in content.items()}))
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
        for old in cache.glob(f"initramfs-{kernel.version}-*.cpio"):
            if old != path:
                old.unlink(missing_ok=True)  # a guest that runs has read it long ago
    except OSError as error:
        raise LabError(f"{cache}: {error.strerror}: the lab keeps its guest there") from error
    return path


def _contents(kernel: Kernel) -> dict[str, Path | str]:
    """Everything in the archive: the name there, and the file or text here."""
    content: dict[str, Path | str] = {"init": _INIT, "bin/busybox": _static_busybox()}
    for tool in ("ip", "tc"):
        found = shutil.which(tool, path=search_path())
        if found is None:
            raise LabError(f"{tool} is missing: apt-get install iproute2")
        content[f"sbin/{tool}"] = Path(found)
        for library in _libraries(found):
            content[str(library).lstrip("/")] = library
    for table in sorted(Path("/usr/lib").glob("**/tc/*.dist")):
        content[str(table).lstrip("/")] = table
    names = []
    for module in kernel.modules:
        names.append(module.name.partition(".ko")[0] + ".ko")
        content[f"modules/{names[-1]}"] = module
    content["modules/order"] = "".join(f"{name}\n" for name in names)
    return content


def _static_busybox() -> Path:
    found = shutil.which("busybox", path=search_path())
    if found is None or b"/ld-linux" in Path(found).read_bytes()[:4096]:
        raise LabError("a statically linked busybox is missing: apt-get install busybox-static")
    return Path(found)


def _libraries(program: str) -> list[Path]:
    """The shared libraries and the loader that a program needs."""
    text = run(["ldd", program])
    return [Path(match) for match in re.findall(r"(?:=> |^\s+)(/\S+) \(0x", text, re.MULTILINE)]


def _mark(name: str, source: Path | str) -> object:
    if isinstance(source, str):
        return name, source
    status = source.stat()
    return name, str(source), status.st_size, status.st_mtime_ns


def _read(source: Path | str) -> bytes:
    if isinstance(source, str):
        return source.encode()
    data = source.read_bytes()
    if source.suffix == ".xz":
        return lzma.decompress(data)
    if source.suffix == ".gz":
        return gzip.decompress(data)
    if source.suffix == ".zst":
        try:
            return subprocess.run(["zstd", "-dc", source], capture_output=True, check=True).stdout
        except (OSError, subprocess.CalledProcessError) as error:
            raise LabError(f"cannot unpack {source}: apt-get install zstd") from error
    return data


def archive(files: Mapping[str, bytes]) -> bytes:
    """A cpio archive in the `newc` format (kernel documentation, initramfs buffer format): these files, executable,
    their directories, and /dev/console, on which the kernel starts init."""
    parents = {str(parent) for name in files for parent in Path(name).parents} - {"."}
    entries = [(name, stat.S_IFDIR | 0o755, b"", (0, 0)) for name in sorted(parents | {"dev", "proc", "sys", "run"})]
    entries.append(("dev/console", stat.S_IFCHR | 0o600, b"", (5, 1)))
    entries += [(name, stat.S_IFREG | 0o755, data, (0, 0)) for name, data in files.items()]
    entries.append(("TRAILER!!!", 0, b"", (0, 0)))
    out = bytearray()
    for inode, (name, mode, data, device) in enumerate(entries, start=1):
        encoded = name.encode() + b"\0"
        fields = (inode, mode, 0, 0, 1, 0, len(data), 0, 0, *device, len(encoded), 0)
        out += b"070701" + b"".join(b"%08x" % field for field in fields) + encoded
        out += bytes(-len(out) % 4) + data
        out += bytes(-len(out) % 4)
    return bytes(out)
