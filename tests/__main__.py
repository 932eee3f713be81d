"""Run every check of the project: ``python -m tests``.

Style, types, import directions, then the tests; stops at the first that fails.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent

CHECKS: tuple[tuple[str, ...], ...] = (
    (sys.executable, "-m", "ruff", "check", "."),
    (sys.executable, "-m", "ruff", "format", "--check", "."),
    (sys.executable, "-m", "mypy"),
    (str(BIN / "lint-imports"),),
    (sys.executable, "-m", "pytest"),
)


def main() -> int:
    """Run the checks in order; the exit status of the first that fails, or 0."""
    for check in CHECKS:
        print("+", *(Path(check[0]).name, *check[1:]), flush=True)
        status = subprocess.run(check, cwd=ROOT, check=False).returncode
        if status:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
