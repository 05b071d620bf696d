"""The quick tests of what changed: those of `make check`.

A changed test file is run itself; of a changed module, the test files that import it. Only tests with the mark `unit`, and for
`--seconds` at most: what had no time is skipped and counted, and `make test` runs it.
"""

import argparse
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def changed(base: str) -> list[str]:
    """Return Python files that differ from a commit, and those that git does not know yet."""
    words = (("diff", "--name-only", "--diff-filter=d", base), ("ls-files", "--others", "--exclude-standard"))
    found = [subprocess.run(["git", *w], cwd=ROOT, capture_output=True, text=True, check=True).stdout for w in words]
    return sorted({name for name in "\n".join(found).splitlines() if name.endswith(".py")})


def tests_of(files: Sequence[str]) -> list[str]:
    """Return the test files that files ask for."""
    modules = [re.escape(name.removesuffix(".py").replace("/", ".")) for name in files if not name.startswith("tests/")]
    own = [name for name in files if re.search(r"(^|/)test_\w+\.py$", name)]
    if not modules:
        return own
    pattern = re.compile(rf"\b(?:{'|'.join(modules)})\b")
    using = [path for path in sorted((ROOT / "tests").rglob("test_*.py")) if pattern.search(path.read_text())]
    return sorted({*own, *(str(path.relative_to(ROOT)) for path in using)})


class TimeIsUp:
    """Skips what is left when the time is over."""

    def __init__(self, seconds: float) -> None:
        self.end = time.monotonic() + seconds

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        if time.monotonic() > self.end:
            pytest.skip("no time left in `make check`; `make test` runs it")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--base", default="HEAD", help="commit that the working tree is compared with")
    parser.add_argument("--seconds", type=float, default=25.0, help="time for tests")
    given = parser.parse_args()
    files = tests_of(changed(given.base))
    if not files:
        print("no test file is concerned")
        return 0
    words = ["-q", "-m", "unit and not slow", "--no-header", "-p", "no:cacheprovider", *files]
    code = int(pytest.main(words, plugins=[TimeIsUp(given.seconds)]))
    return 0 if code == pytest.ExitCode.NO_TESTS_COLLECTED else code


if __name__ == "__main__":
    sys.exit(main())
