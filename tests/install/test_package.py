"""The Debian packages: they install, upgrade and purge in a clean Debian, and leave what its people made."""

import shutil
from pathlib import Path
from typing import Final

import pytest

from tests.install.machine import in_root, run

ONLY_NEW: Final = frozenset({"/etc/group-", "/etc/gshadow-", "/etc/passwd-", "/etc/shadow-"})
"""Copies of before that the tools for users keep."""
LINTIAN_S: Final = 1800.0
"""It looks at 10,000 files, one after the other."""
GONE: Final = frozenset({"/opt"})
"""No package has it: dpkg removes it with the last that was in it."""
OURS: Final = ("/usr/bin/sern", "/usr/bin/sern-relay", "/usr/bin/sern-client")


def files(root: Path) -> set[str]:
    """Everything that there is, but what packages are installed with and logged by."""
    lists = ("/proc", "/sys", "/dev", "/run", "/tmp", "/var/lib/dpkg", "/var/log", "/var/cache")
    found = {"/" + str(path.relative_to(root)) for path in root.rglob("*")}
    return {path for path in found if not path.startswith(lists)}


def install(root: Path, *packages: Path) -> None:
    """As `apt-get install ./FILE` does once it has what the package depends on."""
    for package in packages:
        shutil.copy(package, root / "tmp")
    in_root(root, "dpkg", "--install", *(f"/tmp/{package.name}" for package in packages))


def state(root: Path, name: str) -> str:
    return in_root(root, "dpkg-query", "--show", "--showformat=${db:Status-Status}", name, check=False).stdout


def newer(package: Path, directory: Path) -> Path:
    """The same package as of a later version, in which one file more says so."""
    tree = directory / "tree"
    run(["dpkg-deb", "--raw-extract", package, tree])
    control = tree / "DEBIAN" / "control"
    lines = control.read_text().splitlines()
    control.write_text("".join(f"{line}+later\n" if line.startswith("Version: ") else f"{line}\n" for line in lines))
    (tree / "usr/share/doc/sern/later").write_text("a later version\n")
    later = directory / f"{package.name.removesuffix('.deb')}+later.deb"
    run(["dpkg-deb", "--root-owner-group", "-Znone", "--build", tree, later])
    shutil.rmtree(tree)
    return later


def test_lintian_finds_no_error(sern_package: Path, twin_package: Path) -> None:
    if shutil.which("lintian") is None:
        pytest.skip("apt-get install lintian")
    command: list[str | Path] = ["lintian", "--allow-root", "--fail-on", "error", sern_package, twin_package]
    done = run(command, check=False, timeout_s=LINTIAN_S)
    assert done.returncode == 0, done.stdout


def test_nothing_names_where_it_was_built(sern_package: Path, tmp_path: Path) -> None:
    run(["dpkg-deb", "--raw-extract", sern_package, tmp_path])
    checkout = bytes(Path(__file__).resolve().parents[2])
    ours = [path for path in tmp_path.rglob("*") if path.is_file() and not path.is_symlink()]
    assert len(ours) > 1000
    assert [path for path in ours if checkout in path.read_bytes()] == []
    shutil.rmtree(tmp_path)


def test_a_life(root: Path, sern_package: Path, twin_package: Path, tmp_path: Path) -> None:
    """Installed, used, upgraded, removed, purged; then purged once more with nothing in its folders."""
    before = files(root)
    users = (root / "etc/passwd").read_text()
    install(root, sern_package)
    assert (root / "etc/passwd").read_text().removeprefix(users).startswith("sern:")
    for folder in ("etc/sern", "var/lib/sern"):
        assert (root / folder).stat().st_mode & 0o7777 == 0o700
    for program in OURS:
        assert in_root(root, program, "--version").stdout.startswith(f"{Path(program).name} ")
    assert in_root(root, "dpkg", "--verify", "sern").stdout == ""

    # What a person makes, by the words of the guide, as the user who runs the daemon.
    as_sern = ("setpriv", "--reuid=sern", "--regid=sern", "--clear-groups")
    in_root(root, *as_sern, "sern", "keygen", "relay", "relay", "--out", "/etc/sern")
    in_root(root, *as_sern, "mkdir", "/etc/sern/clients")
    in_root(root, *as_sern, "cp", "/usr/share/doc/sern/examples/relay.yaml", "/etc/sern/")
    checked = in_root(root, *as_sern, "sern", "check", "/etc/sern/relay.yaml")
    assert checked.stdout.splitlines()[-1].endswith("right"), checked.stdout
    recording = root / "var/lib/sern/field.bag"
    recording.write_bytes(b"a day in the field")
    key = (root / "etc/sern/relay.key").read_bytes()

    install(root, newer(sern_package, tmp_path))
    assert (root / "usr/share/doc/sern/later").exists()
    assert (root / "etc/sern/relay.key").read_bytes() == key and recording.read_bytes() == b"a day in the field"
    assert (root / "etc/sern").stat().st_mode & 0o7777 == 0o700

    # Nothing is written below /opt/sern by what runs, so that nothing is left there either.
    in_root(root, "dpkg", "--remove", "sern")
    assert not (root / "opt/sern").exists() and (root / "etc/sern/relay.key").exists()
    purged = in_root(root, "dpkg", "--purge", "sern")
    assert "kept, with keys, configuration or recordings in it: /etc/sern /var/lib/sern" in purged.stderr
    made = {"/etc/sern", "/etc/sern/relay.key", "/etc/sern/relay.pub", "/etc/sern/clients", "/etc/sern/relay.yaml",
            "/var/lib/sern", "/var/lib/sern/field.bag"}  # fmt: skip
    assert files(root) - before - ONLY_NEW == made
    assert before - files(root) <= GONE

    # Again, over what was kept; then all of it goes but the user.
    install(root, sern_package, twin_package)
    assert (root / "etc/sern/relay.key").read_bytes() == key
    in_root(root, "/usr/bin/sern-twin", "--version")
    in_root(root, "rm", "-r", "/etc/sern", "/var/lib/sern")
    purged = in_root(root, "dpkg", "--purge", "sern-twin", "sern")
    assert "kept" not in purged.stderr
    assert files(root) - before - ONLY_NEW == set() and before - files(root) <= GONE
    assert state(root, "sern") == "" and (root / "etc/passwd").read_text().removeprefix(users).startswith("sern:")


def test_an_environment_made_by_hand_is_left_alone(root: Path, sern_package: Path) -> None:
    settings = root / "opt/sern/pyvenv.cfg"
    settings.parent.mkdir(parents=True)
    settings.write_text("home = /usr/bin\n")
    shutil.copy(sern_package, root / "tmp")
    done = in_root(root, "dpkg", "--install", f"/tmp/{sern_package.name}", check=False)
    assert done.returncode != 0
    assert (
        "/opt/sern is an environment that was made by hand" in done.stderr
        and "mv /opt/sern /opt/sern.old" in done.stderr
    )
    assert [path.name for path in settings.parent.iterdir()] == ["pyvenv.cfg"]
    shutil.rmtree(settings.parent)
    in_root(root, "dpkg", "--purge", "sern", check=False)
