"""The same job as a compiled program: Pinocchio's regressor and LAPACK's QR in C++,
with every optimisation.

The headers of Pinocchio are those of the package `pin`; Eigen and OpenBLAS come as packages too,
into a folder of their own, so that no library of the system counts. Without a compiler there is no
program, and the bench says so.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

LIBRARIES = ("cmeel-eigen==3.4.1", "scipy-openblas32==0.3.34.481.3")
SOURCE = Path(__file__).with_name("pinocchio_fit.cpp")
OPTIONS = (
    "-std=c++17",
    "-O3",
    "-march=native",
    "-DNDEBUG",
    # Pinocchio has more kinds of joints than Boost's lists have places by default.
    "-DBOOST_MPL_LIMIT_LIST_SIZE=30",
    "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
    "-DBOOST_FUSION_INVOKE_MAX_ARITY=10",
)


class NotCompiled(Exception):
    """There is no program, and why."""


def compiled(folder: Path) -> Path:
    """Compile the program in a folder and return its path.

    Raises:
        NotCompiled: there is no compiler, or it refuses.
    """
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        raise NotCompiled("found no C++ compiler; expected g++, clang++ or one that CXX names")
    libraries = _libraries(folder / "libraries")
    blas = libraries / "scipy_openblas32" / "lib"
    # All headers of the packages are system headers: their warnings are not ours.
    headers = (
        Path(sysconfig.get_path("purelib")) / "cmeel.prefix" / "include",
        libraries / "cmeel.prefix" / "include" / "eigen3",
    )
    program = folder / "pinocchio_fit"
    command = [compiler, *OPTIONS]
    for path in headers:
        command += ["-isystem", str(path)]
    command += [
        str(SOURCE),
        "-o",
        str(program),
        f"-L{blas}",
        "-lscipy_openblas",
        f"-Wl,-rpath,{blas.resolve()}",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise NotCompiled(f"{compiler} refuses: {done.stderr[-2000:]}")
    return program


def _libraries(folder: Path) -> Path:
    """Folder with Eigen and OpenBLAS, installed once."""
    installed = folder / ".installed"
    wanted = " ".join(LIBRARIES)
    if not installed.exists() or installed.read_text() != wanted:
        shutil.rmtree(folder, ignore_errors=True)
        install = [
            sys.executable,
            "-m",
            "pip",
            "install",
            "-qq",
            "--no-deps",
            "--target",
            str(folder),
            *LIBRARIES,
        ]
        subprocess.run(install, check=True)
        installed.write_text(wanted)
    return folder
