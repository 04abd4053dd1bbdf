"""Generate and compile event_camera_msgs for the ROS 2 of PyPI: `.venv-ros2/bin/python make_messages.py`.

No registry has this package. The generators of the wheels write its C code; a compiler makes the libraries that rclpy
loads. It needs gcc and the headers of Python.
"""

import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

PACKAGE = "event_camera_msgs"
TYPE = """#include "std_msgs/msg/Header.idl"
module event_camera_msgs {
  module msg {
    struct EventPacket {
      std_msgs::msg::Header header;
      uint32 height;
      uint32 width;
      uint64 seq;
      uint64 time_base;
      string encoding;
      boolean is_bigendian;
      sequence<uint8> events;
    };
  };
};
"""
PREFIX = Path(sys.prefix)
LIBRARIES = ("rosidl_generator_c", "rosidl_typesupport_fastrtps_c", "rosidl_typesupport_c", "rosidl_generator_py")


def generate(folder: Path) -> None:
    """The C and Python code of the message."""
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_generator_type_description.cli import HashTypeDescription
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport

    (folder / "msg").mkdir(parents=True)
    (folder / "msg" / "EventPacket.idl").write_text(TYPE)
    (folder / "msg" / "EventPacket.msg").touch()  # its text goes into the description of the type alone
    files, include = [f"{folder}:msg/EventPacket.idl"], [str(PREFIX / "share")]
    hashes = HashTypeDescription("hash").generate_type_hashes(PACKAGE, files, include, folder)
    GenerateC("c").generate(PACKAGE, files, include, folder, hashes)
    only = ["rosidl_typesupport_fastrtps_c"]
    for generator in (
        GenerateCTypesupport("c", typesupport_implementations=only),
        GenerateFastRTPSCTypesupport("fastrtps_c"),
        GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c"]),
    ):
        generator.generate(PACKAGE, files, include, folder)


def compile_all(folder: Path) -> None:
    """The libraries, and the extension module of the package."""
    import numpy

    parent = folder.parent
    includes = [parent, sysconfig.get_path("include"), numpy.get_include()]
    includes += [PREFIX / "include", *(path for path in (PREFIX / "include").iterdir() if path.is_dir())]
    flags = ["-shared", "-fPIC", "-O1", "-w", f"-L{PREFIX / 'lib'}", *(f"-I{path}" for path in includes)]
    common = [
        "rosidl_runtime_c",
        "rosidl_typesupport_fastrtps_c",
        "rosidl_typesupport_fastrtps_cpp",
        "rosidl_typesupport_c",
    ]
    common += ["fastcdr", "rcutils", "rmw", *(f"std_msgs__{name}" for name in LIBRARIES)]
    common += [f"builtin_interfaces__{name}" for name in LIBRARIES]
    linked: list[str] = []
    detail = folder / "msg" / "detail"
    sources = {
        "rosidl_generator_c": [
            detail / f"event_packet__{name}.c" for name in ("functions", "description", "type_support")
        ],
        "rosidl_typesupport_fastrtps_c": [detail / "event_packet__type_support_c.cpp"],
        "rosidl_typesupport_c": [folder / "msg" / "event_packet__type_support.cpp"],
        "rosidl_generator_py": [folder / "msg" / "_event_packet_s.c"],
    }
    for name, files in sources.items():
        out = PREFIX / "lib" / f"lib{PACKAGE}__{name}.so"
        libraries = [f"-l{one}" for one in (*linked, *common)]
        subprocess.run(["g++", *_languages(files), *flags, *libraries, "-o", out], check=True)
        linked.append(f"{PACKAGE}__{name}")
    site = Path(sysconfig.get_path("purelib")) / PACKAGE
    (site / "msg").mkdir(parents=True, exist_ok=True)
    for file in folder.glob("**/*.py"):
        (site / file.relative_to(folder)).write_text(file.read_text())
    (site / "__init__.py").touch()
    module = site / f"{PACKAGE}_s__rosidl_typesupport_c.{sysconfig.get_config_var('SOABI')}.so"
    entry = [folder / f"_{PACKAGE}_s.ep.rosidl_typesupport_c.c"]
    libraries = [f"-l{one}" for one in (*reversed(linked), *common)]
    subprocess.run(["g++", *_languages(entry), *flags, *libraries, "-o", module], check=True)


def _languages(files: list[Path]) -> list[str]:
    """Arguments for sources of C and C++."""
    words: list[str] = []
    for file in files:
        words += ["-x", "c" if file.suffix == ".c" else "c++", str(file)]
    return [*words, "-x", "none"]


def main() -> None:
    """Generate and compile."""
    import os

    os.environ["AMENT_PREFIX_PATH"] = str(PREFIX)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / PACKAGE
        generate(folder)
        compile_all(folder)


if __name__ == "__main__":
    main()
