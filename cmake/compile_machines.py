"""Translate the state machines into C, for CMake to compile.

``python cmake/compile_machines.py SOURCE OUTPUT`` is run by CMake with -DHOLDFAST_COMPILED=ON. It
lets mypy's compiler translate the modules and leaves OUTPUT/modules.cmake: for each extension
module, its sources and include directories.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

PACKAGES = ("protocol",)

INTERPRETED = {
    # Types with class keywords, which the compiler does not know.
    "protocol/messages.py",
    "protocol/service_limits.py",
    # Nothing in them takes time.
    "protocol/__init__.py",
    "protocol/effects.py",
    "protocol/robot_events.py",
    "protocol/status.py",
    "protocol/verification.py",
}


def main() -> None:
    """Translate, and say what there is to compile."""
    source, output = (Path(argument).resolve() for argument in sys.argv[1:])
    try:
        # The first gives the second its build tools where Python has none.
        import setuptools  # noqa: F401
        from mypyc.build import mypycify
    except ImportError as error:
        sys.exit(
            f"{error}: compiled machines need mypy and setuptools to build; "
            "with HOLDFAST_COMPILED=1 in its environment, pip gets them"
        )
    package = source / "src" / "holdfast"
    modules = sorted(
        str(path.relative_to(source / "src"))
        for folder in PACKAGES
        for path in (package / folder).glob("*.py")
        if str(path.relative_to(package)) not in INTERPRETED
    )
    output.mkdir(parents=True, exist_ok=True)
    os.chdir(source / "src")
    extensions = mypycify(
        [
            "--config-file=",
            # What only an extra has is not there when a wheel is built.
            "--ignore-missing-imports",
            f"--cache-dir={output / 'cache'}",
            *modules,
        ],
        target_dir=str(output),
        group_name="holdfast._machines",
        multi_file=True,
    )
    lines = []
    for extension in extensions:
        # What belongs to a module within a package is included without the package's name.
        included = [*extension.include_dirs, str(output / "holdfast")]
        lines += [
            f"list(APPEND compiled_modules {extension.name})",
            f"set({extension.name}_sources {quoted(extension.sources)})",
            f"set({extension.name}_includes {quoted(included)})",
        ]
    (output / "modules.cmake").write_text("\n".join(lines) + "\n", encoding="utf-8")


def quoted(paths: list[str]) -> str:
    """Return paths as arguments of CMake's."""
    return " ".join(f'"{Path(path).as_posix()}"' for path in paths)


if __name__ == "__main__":
    main()
