"""The library in C, built and installed away from the checkout, and called by `ctypes`."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples" / "cpp"
LANDMARKS = 63
INVALID_INPUT, INVALID_HAND, BUSY, FAILED = 1, 2, 3, 4
_Numbers = ctypes.POINTER(ctypes.c_double)


class Options(ctypes.Structure):
    """`handmap_options`."""

    _fields_ = (
        ("rejoin", ctypes.c_int),
        ("smooths", ctypes.c_int),
        ("acceleration", ctypes.c_double),
        ("speed_gain", ctypes.c_double),
    )


class Sample(ctypes.Structure):
    """`handmap_sample`."""

    _fields_ = (
        ("time", ctypes.c_double),
        ("landmarks", _Numbers),
        ("wrist", _Numbers),
        ("valid", ctypes.c_int),
        ("confidence", ctypes.c_double),
        ("arrival", ctypes.c_double),
        ("dt", ctypes.c_double),
    )


class Command(ctypes.Structure):
    """`handmap_command`."""

    _fields_ = (
        ("time", ctypes.c_double),
        ("wrist", ctypes.c_double * 16),
        ("q", _Numbers),
        ("velocity", _Numbers),
        ("joints", ctypes.c_size_t),
        ("status", ctypes.c_int),
        ("is_held", ctypes.c_int),
        ("is_gliding", ctypes.c_int),
        ("rule", ctypes.c_char_p),
        ("mistake", ctypes.c_char_p),
    )


def installed_library(folder: Path) -> Path:
    """Build the library and install it into a folder; skip without a compiler.

    Returns:
        Where it is installed.
    """
    if shutil.which("g++") is None:
        pytest.skip("needs g++")
    prefix = folder / "installed"
    # A third of the time that the default takes to compile; results are the same.
    flags = [
        "-DCMAKE_CXX_FLAGS_RELEASE=-O1",
        "-DBUILD_SHARED_LIBS=ON",
        f"-DCMAKE_INSTALL_PREFIX={prefix}",
    ]
    build = folder / "library"
    run("cmake", "-S", ROOT / "core", "-B", build, "-G", "Ninja", *flags)
    run("cmake", "--install", build, after=("cmake", "--build", build))
    return prefix


def built_examples(prefix: Path, folder: Path) -> Path:
    """Copy the examples elsewhere, and build them with an installed library.

    Returns:
        The folder of the programs.
    """
    sources = folder / "sources"
    shutil.copytree(EXAMPLES, sources)
    build = folder / "programs"
    wanted = f"-DCMAKE_PREFIX_PATH={prefix}"
    run("cmake", "-S", sources, "-B", build, "-G", "Ninja", wanted)
    run("cmake", "--build", build)
    return build


def linked_program(source: Path, prefix: Path, folder: Path) -> Path:
    """Compile a program that calls an installed library; it may use the examples' headers.

    Returns:
        The program.
    """
    program = folder / source.stem
    (library,) = prefix.glob("lib*/libhandmap.so")
    headers = [f"-I{prefix / 'include'}", f"-I{EXAMPLES}"]
    link = [library, f"-Wl,-rpath,{library.parent}", "-ldl", "-o", program]
    run("g++", "-std=c++17", "-O0", "-Wall", "-Werror", *headers, source, *link)
    return program


def run(*command: str | Path, after: tuple[str | Path, ...] = ()) -> str:
    """Run a program without Python's environment; return what it prints.

    Args:
        command: The program and its arguments.
        after: Another one, to be run before it.

    Raises:
        AssertionError: If it fails, with what it says.
    """
    if after:
        run(*after)
    programs = Path(sys.executable).parent
    path = f"{programs}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        env={"PATH": path, "HOME": os.environ.get("HOME", "/")},
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


def loaded(prefix: Path) -> ctypes.CDLL:
    """Return the installed library, with the types of its functions."""
    (file,) = prefix.glob("lib*/libhandmap.so")
    library = ctypes.CDLL(str(file))
    hand = ctypes.c_void_p
    command = ctypes.POINTER(Command)
    for name in ("version", "last_error", "status_name", "name", "side", "joint_name"):
        getattr(library, f"handmap_{name}").restype = ctypes.c_char_p
    library.handmap_usual_dt.restype = ctypes.c_double
    library.handmap_joint_count.restype = ctypes.c_size_t
    library.handmap_human_joint_count.restype = ctypes.c_size_t
    library.handmap_human_joint_name.restype = ctypes.c_char_p
    library.handmap_link_name.restype = ctypes.c_char_p
    library.handmap_link_count.restype = ctypes.c_size_t
    library.handmap_default_options.restype = Options
    library.handmap_new_sample.restype = Sample
    library.handmap_new_sample.argtypes = [ctypes.c_double, _Numbers]
    library.handmap_load.argtypes = [
        ctypes.c_char_p,
        ctypes.c_size_t,
        ctypes.POINTER(Options),
        ctypes.POINTER(hand),
    ]
    number, numbers = ctypes.c_double, _Numbers
    for name, arguments in {
        "free": [],
        "name": [],
        "side": [],
        "usual_dt": [],
        "joint_count": [],
        "joint_name": [ctypes.c_size_t],
        "joint_limits": [numbers, numbers, numbers],
        "human_joint_count": [],
        "human_joint_name": [ctypes.c_size_t],
        "link_count": [],
        "link_name": [ctypes.c_size_t],
        "link_poses": [numbers],
        "human_landmarks": [numbers, numbers, numbers],
        "follow": [ctypes.POINTER(Sample), command],
        "map_landmarks": [numbers, numbers, number, command],
        "map_joints": [numbers, numbers, number, command],
        "hold": [number, command],
        "engage": [],
        "disengage": [],
        "stop": [number, command],
    }.items():
        getattr(library, f"handmap_{name}").argtypes = [hand, *arguments]
    return library
