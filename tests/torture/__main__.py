"""The fault campaign, `make torture`: kills, bad places, bad inputs. Ends with a table, and exit code 1 if anything was lost.

python -m tests.torture --kills 60 --mutations 500 --out runs/torture
"""

import argparse
import os
import signal
import sys
from pathlib import Path

from tests.torture import kills, mutations, places
from tests.torture.tally import Row, table


def main() -> None:
    """Run what was asked for, and say what came of it."""
    parser = argparse.ArgumentParser(prog="tests.torture", description=__doc__)
    parser.add_argument("--kills", type=int, default=60, help="of fit; other verbs have a share (60: about 200 in all)")
    parser.add_argument("--mutations", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=("kills", "interrupts", "mutations", "places"), default=None)
    parser.add_argument("--verbs", nargs="+", default=(), help="of the kills; left out: all")
    parser.add_argument("--out", type=Path, required=True)
    asked = parser.parse_args()
    out = asked.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    os.environ["XDG_CACHE_HOME"] = str(out / "cache")  # a kill may hit it, too: it is not the user's own
    only = asked.only or ("kills", "interrupts", "mutations", "places")
    rows: list[Row] = []
    if "kills" in only:
        rows += kills.campaign(out, asked.kills, asked.seed, signal.SIGKILL, asked.verbs)
    if "interrupts" in only:
        rows += kills.campaign(out, max(2, asked.kills // 4), asked.seed + 1, signal.SIGINT, asked.verbs)
    if "places" in only:
        rows += places.campaign(out)
    if "mutations" in only:
        rows += mutations.campaign(out, asked.mutations, asked.seed)
    lines = table(rows)
    (out / "torture.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))
    sys.exit(any(row.losses or row.tracebacks or row.exact < row.resumed for row in rows))


if __name__ == "__main__":
    main()
