"""Generate and compile the packages in `interfaces/` into a ROS 2 environment, with its own generators.

`build_types.py PLACE`, run by the Python of PLACE: robots have these packages, and no wheel does. Needs catkin_pkg, cc
and c++, which take half a minute. Their fields are those of the packages of the same names, without comments and
constants.
"""

# mypy: ignore-errors
# It runs among the packages of ROS, whose types are not known where it is checked.

import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

from rosidl_cli.command.translate.api import translate
from rosidl_generator_c.cli import GenerateC
from rosidl_generator_py.cli import GeneratePython
from rosidl_typesupport_c.cli import GenerateCTypesupport
from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

HERE = Path(__file__).resolve().parent / "interfaces"
SUPPORTS = ["rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c"]
"""Type supports behind `rosidl_typesupport_c`, which picks one when a process starts."""
GENERATORS = (
    GenerateC("c"),
    GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c", *SUPPORTS]),
    GenerateCTypesupport("c", typesupport_implementations=SUPPORTS),
    GenerateFastRTPSCTypesupport("fastrtps_c"),
)


def build(place, package):
    share, python = place / "share" / package, Path(sysconfig.get_path("purelib")) / package
    for folder in (share, python):
        shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(HERE / package, share)
    interfaces = [str(file.relative_to(share)) for file in sorted(share.rglob("*.*"))]
    known = [str(folder) for folder in sorted((place / "share").iterdir()) if folder != share]
    with tempfile.TemporaryDirectory() as there:
        made = Path(there) / package
        idl = translate(
            package_name=package,
            interface_files=[f"{share}:{name}" for name in interfaces],
            include_paths=known,
            output_format="idl",
            output_path=share,
        )
        for generator in GENERATORS:
            generator.generate(package, idl, known, output_path=made)
        # Its sources have the names of others.
        introspection = Path(there) / "introspection" / package
        GenerateIntrospectionCTypesupport("introspection_c").generate(package, idl, known, output_path=introspection)
        (made / "__init__.py").touch()
        compile_all(place, package, made, introspection)
        shutil.copytree(made, python, ignore=shutil.ignore_patterns("*.c", "*.cpp", "*.h", "tmp", "detail"))


def compile_all(place, package, made, introspection):
    def ending(*ends, below=made):
        return sorted(str(file) for file in below.glob("*/detail/*") if file.name.endswith(ends))

    own = {
        "generator_c": ending("__functions.c", "__description.c", "__type_support.c"),
        "typesupport_introspection_c": ending("__type_support.c", below=introspection),
        "typesupport_fastrtps_c": ending("__type_support_c.cpp"),
        "typesupport_c": sorted(str(file) for file in made.glob("*/*__type_support.cpp")),
        "generator_py": sorted(str(file) for file in made.glob("*/_*_s.c")),
    }
    for kind, sources in own.items():
        shared(place, made, place / "lib" / f"lib{package}__rosidl_{kind}.so", sources)
    for source in made.glob("_*_s.ep.*.c"):
        support = source.name.split(".ep.")[1].removesuffix(".c")
        shared(place, made, made / f"{package}_s__{support}.so", [str(source)])


def shared(place, made, library, sources):
    """Compile the sources into a library that finds those beside it."""
    assert sources, f"nothing was generated for {library.name}"
    compiler = "c++" if sources[0].endswith(".cpp") else "cc"
    folders = [
        made.parent,
        made.parent / "introspection",
        sysconfig.get_path("include"),
        numpy_headers(),
        place / "include",
    ]
    folders += sorted((place / "include").iterdir())
    libraries = [*place.glob("lib/lib*__rosidl_*.so"), *place.glob("lib/librosidl_*.so")]
    libraries += [*place.glob("lib/librmw.so"), *place.glob("lib/librcutils.so"), *place.glob("lib/libfastcdr.so*")]
    includes = [f"-I{folder}" for folder in folders]
    others = sorted(str(each) for each in libraries if each != library)
    linking = [f"-Wl,-rpath,{place / 'lib'}", "-Wl,--as-needed", *others]
    command = [compiler, "-shared", "-fPIC", "-O0", "-w", *includes, *sources, "-o", str(library), *linking]
    subprocess.run(command, check=True)


def numpy_headers():
    import numpy

    return numpy.get_include()


if __name__ == "__main__":
    os.environ["AMENT_PREFIX_PATH"] = sys.argv[1]
    for each in sorted(folder.name for folder in HERE.iterdir()):
        build(Path(sys.argv[1]), each)
