"""The table of benches/benchmarks.md: figures that this run measured, beside those of the run before."""

import datetime
import os
import re
import sys

from . import figures, programs

PAGE = programs.PROJECT / "benches" / "benchmarks.md"
HEAD = "| figure | peer | ratio | before | measured |\n|---|---|---|---|---|\n"
# A figure that has grown by more than a third is slower.
SLOWER = 4 / 3


def compare(rows, path=PAGE):
    """The table's new rows, and what has been compared. `rows` have figure, peer and ratio."""
    known = read(path)
    when = f"{datetime.date.today()}, {machine()}"
    compared = []
    for figure, peer, ratio in rows:
        before = known[figure][1] if figure in known else None
        known[figure] = (peer, ratio, before, when)
        is_slower = before is not None and ratio > SLOWER * before
        compared.append({"figure": figure, "peer": peer, "ratio": ratio, "before": before, "is_slower": is_slower})
    return known, compared


def show(compared):
    rows = []
    for row in compared:
        before = "-" if row["before"] is None else f"{row['before']:.2f}"
        rows.append([row["figure"], row["peer"], f"{row['ratio']:.2f}", before, "slower" if row["is_slower"] else ""])
    print()
    figures.table(["figure", "peer", "ratio", "before", ""], rows)


def machine():
    found = programs.describe_machine()
    rustc = found["versions"].split()[1]
    return f"{os.cpu_count()} {found['machine'].split(' ', 1)[1]}, rustc {rustc}"


def split(path):
    """The text before the table, the table's lines and the text behind it."""
    text = path.read_text()
    before, head, rest = text.partition(HEAD)
    if not head:
        sys.exit(f"{path}: expected the table that begins with '{HEAD.splitlines()[0]}'")
    rows = re.match(r"(\|.*\n)*", rest)[0]
    return before, rows, rest[len(rows) :]


def read(path=PAGE):
    """{figure: (peer, ratio, ratio before, when)}."""
    rows = {}
    for line in split(path)[1].splitlines():
        figure, peer, ratio, before, when = [cell.strip() for cell in line.strip("|").split("|")]
        rows[figure] = (peer, float(ratio), None if before == "-" else float(before), when)
    return rows


def write(rows, path=PAGE):
    before, _, behind = split(path)
    lines = []
    for figure, (peer, ratio, earlier, when) in rows.items():
        shown = "-" if earlier is None else f"{earlier:.2f}"
        lines.append(f"| {figure} | {peer} | {ratio:.2f} | {shown} | {when} |\n")
    path.write_text(before + HEAD + "".join(lines) + behind)
