"""Makes a virtual environment that was built elsewhere one of /opt/sern, in two packages. Standard library alone.

    settle.py BUILT TWIN LIST

BUILT is the environment, TWIN where what the second package has of it goes, LIST names the files of the first, a line
each, relative to BUILT.
"""

import compileall
import py_compile
import shutil
import sys
from pathlib import Path
from typing import Final

HOME: Final = Path("/opt/sern")
OF_TWIN: Final = ("bin/sern-twin", "bin/sern-navigation")
NO_PIP: Final = ("RECORD", "INSTALLER", "REQUESTED", "direct_url.json")
"""What pip writes for itself: paths and hashes of this build. dpkg has its own list."""
FOR_COMPILERS: Final = ("include", "share", "lib/pkgconfig", "lib/libdraco.a")


def relocate(built: Path) -> None:
    """Name HOME wherever the environment names its place; of programs leave Python and SERN's, and nothing for shells,
    compilers and pip."""
    for name in FOR_COMPILERS:
        path = built / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    for path in (built / "bin").iterdir():
        if not path.name.startswith(("python", "sern")):
            path.unlink()
        elif not path.is_symlink():
            path.write_bytes(path.read_bytes().replace(bytes(built), bytes(HOME), 1))
    settings = built / "pyvenv.cfg"
    lines = settings.read_text().splitlines(keepends=True)
    settings.write_text("".join(line for line in lines if not line.startswith("command")))
    for info in built.glob("lib/*/site-packages/*.dist-info"):
        for name in NO_PIP:
            (info / name).unlink(missing_ok=True)


def remains(built: Path) -> list[Path]:
    """Text files that still name the place of the build."""
    names = [*built.glob("bin/*"), built / "pyvenv.cfg", *built.glob("lib/*/site-packages/*.dist-info/*")]
    return [path for path in names if path.is_file() and not path.is_symlink() and bytes(built) in path.read_bytes()]


def split(built: Path, twin: Path, first: set[str]) -> None:
    """Move what is not of the first package."""
    for path in sorted(built.rglob("*")):
        name = str(path.relative_to(built))
        if (path.is_symlink() or not path.is_dir()) and (name not in first or name in OF_TWIN):
            target = twin / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(path, target)
    for path in sorted(built.rglob("*"), reverse=True):
        if path.is_dir() and not path.is_symlink() and not any(path.iterdir()):
            path.rmdir()


def compile_all(root: Path) -> bool:
    """Compile in the order of names, so that each build writes the same; checked by nobody but dpkg."""
    return all(
        compileall.compile_file(
            path, quiet=2, stripdir=str(root), prependdir=str(HOME),
            invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH,
        )
        for path in sorted(root.glob("lib/*/site-packages/**/*.py"))
    )  # fmt: skip


def main(built: Path, twin: Path, listed: Path) -> int:
    for cache in list(built.rglob("__pycache__")):  # of what ran while it was built: each package makes its own below
        shutil.rmtree(cache)
    first = {line.removeprefix("./") for line in listed.read_text().splitlines()}
    relocate(built)
    if left := remains(built):
        print(f"these still name the place of the build: {', '.join(map(str, left))}", file=sys.stderr)
        return 1
    split(built, twin, first)
    for root in (built, twin):
        if not compile_all(root):
            print(f"not everything below {root} could be compiled", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main(*map(Path, sys.argv[1:4])))
