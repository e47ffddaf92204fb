"""Write what drivegain and its extras take on disk into the page on installing.

    python -m docs.sizes

The distributions of this environment are measured: what the wheel needs, what each extra adds to that, and what numpy
and scipy take alone. An extra that is not installed here has no size.
"""

from __future__ import annotations

import marshal
import re
import sys
import warnings
from collections.abc import Iterable
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PAGE = Path(__file__).parent / "install.md"
PART = re.compile(r"(<!-- measured: sizes -->\n).*?(<!-- measured until here -->)", re.DOTALL)
BYTES_PER_MB = 1_000_000
BLOCK_BYTES = 4096
PYC_HEADER_BYTES = 16
EXTRAS = ("simulation", "physical", "parquet", "ros1", "fleet", "console", "foxglove")


def closure(names: Iterable[str]) -> frozenset[str]:
    """Distributions that the named ones need, themselves included; a name may have an extra in brackets.

    Raises:
        PackageNotFoundError: one of them is not installed.
    """
    open_names = [Requirement(name) for name in names]
    seen: set[tuple[str, str]] = set()
    while open_names:
        wanted = open_names.pop()
        for extra in ("", *wanted.extras):
            key = (canonicalize_name(wanted.name), extra)
            if key not in seen:
                seen.add(key)
                open_names += _requirements(distribution(wanted.name), extra)
    return frozenset(name for name, _ in seen)


def _requirements(found: Distribution, extra: str) -> list[Requirement]:
    environment = {
        **{name: str(value) for name, value in default_environment().items()},
        "extra": extra,
    }
    needed = [Requirement(text) for text in found.requires or ()]
    return [one for one in needed if one.marker is None or one.marker.evaluate(environment)]


def megabytes(names: Iterable[str]) -> float:
    """What the files of the distributions take on disk, with the compiled modules that pip makes."""
    blocks = 0
    for name in names:
        located = [Path(str(file.locate())) for file in distribution(name).files or ()]
        for path in located:
            # Whether a module is compiled here depends on who has imported it.
            if path.suffix == ".pyc" or not path.is_file():
                continue
            blocks += _blocks(path.stat().st_size)
            if path.suffix == ".py":
                blocks += _blocks(_compiled_bytes(path))
    return blocks * BLOCK_BYTES / BYTES_PER_MB


def _blocks(size_bytes: int) -> int:
    return -(-size_bytes // BLOCK_BYTES)


def _compiled_bytes(path: Path) -> int:
    """Size of the compiled module; 0 of one that no interpreter of this version compiles."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            code = compile(path.read_bytes(), str(path), "exec", dont_inherit=True)
    except (SyntaxError, ValueError):
        return 0
    return PYC_HEADER_BYTES + len(marshal.dumps(code))


def measured() -> dict[str, float]:
    """Size by what is installed [MB]."""
    base = closure(["drivegain"])
    sizes = {
        "numpy and scipy, for `ident` alone": megabytes(closure(["numpy", "scipy"])),
        "the wheel with all that it needs": megabytes(base),
    }
    for extra in EXTRAS:
        try:
            added = closure([f"drivegain[{extra}]"]) - base
        except PackageNotFoundError:
            continue
        sizes[f"`{extra}` adds"] = megabytes(added)
    return sizes


def table(sizes: dict[str, float]) -> str:
    """The sizes as Markdown, to two digits."""
    rows = [f"| {name} | {float(f'{size:.2g}'):.0f} |" for name, size in sizes.items()]
    return "\n".join(["| installed | MB |", "|---|---:|", *rows])


def main() -> None:
    """Write the table into the page."""
    text = table(measured())
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(
        PART.sub(lambda found: f"{found[1]}\n{text}\n\n{found[2]}", page), encoding="utf-8"
    )
    sys.stdout.write(f"{text}\n")


if __name__ == "__main__":
    main()
