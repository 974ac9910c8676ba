# SPDX-License-Identifier: Apache-2.0
"""Generate and compile a message package with the generators of the ROS wheels and a C and C++ compiler.

CMake's `rosidl_generate_interfaces` does the same for Python. The wheels lack its dependency rosidl_core_generators, so
this module calls the generators one by one. It omits type supports that rclpy with Fast DDS does not use.

    python test/compiled_messages.py yolo_msgs FOLDER    # FOLDER goes on PYTHONPATH
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path

from foreign_messages import DEFINITIONS

PREFIX = Path(sys.prefix)
DEPENDENCIES = ("builtin_interfaces", "std_msgs", "geometry_msgs")
_SUPPORTS = (
    "rosidl_generator_c",
    "rosidl_generator_py",
    "rosidl_typesupport_fastrtps_c",
    "rosidl_typesupport_introspection_c",
    "rosidl_typesupport_c",
)
_RUNTIME = ("rosidl_runtime_c", *_SUPPORTS[2:], "fastcdr", "rcutils")


def lacking() -> str:
    """Return the tools that this machine lacks to compile a package, '' if none."""
    if not (PREFIX / "include/rosidl_runtime_c").is_dir() or not find_spec("rosidl_generator_py"):
        return "ROS' message generators and headers, which come with the wheels of rclpy"
    if not (Path(sysconfig.get_path("include")) / "Python.h").exists():
        return "Python's headers (apt: python3-dev)"
    missing = [tool for tool in ("cc", "c++") if not shutil.which(tool)]
    return f"a C and C++ compiler ({', '.join(missing)})" if missing else ""


def build(package: str, folder: Path, definitions: dict[str, str] = DEFINITIONS) -> None:
    """Put the importable package and its libraries into `folder`; raise CalledProcessError if it does not compile."""
    work = folder / f"{package}_build"
    python, *others = generate(package, work, definitions)
    sources = [file for part in (python, *others) for file in sorted(part.rglob("*.c*"))]
    with ThreadPoolExecutor(2) as pool:
        objects = dict(zip(sources, pool.map(lambda source: _compile(source, work), sources)))
    home = folder / package
    shutil.copytree(python, home, ignore=shutil.ignore_patterns("*.c", "*.o"))
    # The type supports are looked up by these names; the extension loads them.
    library, twin = (folder / f"lib{package}__rosidl_typesupport_{kind}_c.so" for kind in ("fastrtps", "introspection"))
    _link(library, [out for source, out in objects.items() if python not in source.parents])
    _link(twin, [library])
    extension = home / f"{package}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
    _link(extension, [*(out for source, out in objects.items() if python in source.parents), library, twin])


def _link(out: Path, parts: list[Path]) -> None:
    names = [f"{dependency}__{support}" for dependency in DEPENDENCIES for support in _SUPPORTS]
    libraries = [f"-l{name}" for name in (*names, *_RUNTIME)]
    paths = [f"-L{PREFIX}/lib", *(f"-Wl,-rpath,{place}" for place in (PREFIX / "lib", out.parent, out.parent.parent))]
    _run("c++", "-shared", "-Wl,--no-as-needed", f"-Wl,-soname,{out.name}", "-o", out, *parts, *paths, *libraries)


def generate(package: str, work: Path, definitions: dict[str, str]) -> list[Path]:
    """Generate all sources of the package; return the folders of the Python part and of the C part."""
    from rosidl_adapter.msg import convert_msg_to_idl
    from rosidl_generator_c import generate_c
    from rosidl_generator_py import generate_py
    from rosidl_generator_type_description import generate_type_hash
    from rosidl_typesupport_c import generate_c as generate_type_support
    from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c
    from rosidl_typesupport_introspection_c import generate_c as generate_introspection

    names = [name.split("/")[2] for name in definitions if name.startswith(f"{package}/")]
    (work / "msg").mkdir(parents=True)
    for name in names:
        (work / f"msg/{name}.msg").write_text(definitions[f"{package}/msg/{name}"])
        convert_msg_to_idl(work, package, Path(f"msg/{name}.msg"), work / "msg")

    def arguments(output: Path, generator: str = "") -> str:
        output.mkdir(parents=True, exist_ok=True)
        file = work / f"{output.name}_{generator}.json"
        content = {
            "package_name": package,
            "output_dir": str(output),
            "idl_tuples": [f"{work}:msg/{name}.idl" for name in names],
            "include_paths": [f"{dependency}:{PREFIX}/share/{dependency}" for dependency in DEPENDENCIES],
            "template_dir": str(PREFIX / f"share/{generator}/resource"),
            "target_dependencies": [],
            "ros_interface_dependencies": [],
        }
        if generator:
            content["type_description_tuples"] = [f"msg/{name}.idl:{work}/hashes/msg/{name}.json" for name in names]
        file.write_text(json.dumps(content))
        return str(file)

    c, python = work / "include" / package, work / "py" / package
    generate_type_hash(arguments(work / "hashes"))
    generate_c(arguments(c, "rosidl_generator_c"))
    generate_typesupport_fastrtps_c(arguments(c, "rosidl_typesupport_fastrtps_c"))
    generate_introspection(arguments(c, "rosidl_typesupport_introspection_c"))
    for support in _SUPPORTS:
        _visibility(package, support, c)
    generate_type_support(arguments(c, "rosidl_typesupport_c"), list(_SUPPORTS[2:4]))
    generate_py(arguments(python, "rosidl_generator_py"), ["rosidl_typesupport_c"])
    (python / "__init__.py").touch()
    return [python, c]


def _visibility(package: str, generator: str, folder: Path) -> None:
    template = PREFIX / f"share/{generator}/resource/{generator}__visibility_control.h.in"
    if template.exists():
        text = template.read_text().replace("@PROJECT_NAME_UPPER@", package.upper()).replace("@PROJECT_NAME@", package)
        (folder / "msg" / template.stem).write_text(text)


def _compile(source: Path, work: Path) -> Path:
    import numpy

    places = [work / "include", Path(sysconfig.get_path("include")), Path(numpy.get_include())]
    places += [PREFIX / "include", *(folder for folder in (PREFIX / "include").iterdir() if folder.is_dir())]
    out = source.with_suffix(source.suffix + ".o")
    compiler = ["cc"] if source.suffix == ".c" else ["c++", "-std=c++17"]
    _run(*compiler, "-O0", "-w", "-fPIC", "-c", source, "-o", out, *(f"-I{place}" for place in places))
    return out


def _run(*command) -> None:
    subprocess.run([str(part) for part in command], check=True, capture_output=True, text=True)


if __name__ == "__main__":
    try:
        build(sys.argv[1], Path(sys.argv[2]))
    except subprocess.CalledProcessError as failed:
        sys.exit(f"{' '.join(failed.cmd[:6])} ...\n{failed.stderr}")
