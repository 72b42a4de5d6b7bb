"""What all subjects do with figures: rounds in turn, medians, ratios, quantiles, tables."""

import math
import statistics
import sys


def progress(text):
    print(text, file=sys.stderr, flush=True)


def in_turn(n_rounds, sides):
    """Calls each side once a round, so that whatever else the machine does hits all alike.

    `sides` are functions by name. The result has for each name the figures of each round.
    """
    runs = {side: [] for side in sides}
    for nth in range(1, n_rounds + 1):
        for side, run in sides.items():
            progress(f"round {nth} of {n_rounds}: {side}")
            runs[side].append(run())
    return runs


def medians(runs):
    """The median of each figure over the rounds, by side. A figure that a side lacks in the first round is left out."""
    return {
        side: {figure: statistics.median(one[figure] for one in rounds) for figure in rounds[0]}
        for side, rounds in runs.items()
    }


def ratios(runs, base):
    """Each figure over that of the side `base` in the same round, which has met the same load: median, least and most."""
    found = {}
    for side, rounds in runs.items():
        if side == base:
            continue
        found[side] = {}
        for figure in rounds[0]:
            pairs = [(one[figure], other.get(figure)) for one, other in zip(rounds, runs[base])]
            if all(other for _, other in pairs):
                quotients = sorted(one / other for one, other in pairs)
                found[side][figure] = [statistics.median(quotients), quotients[0], quotients[-1]]
    return found


def quantile(values, share):
    """The least value that at least this share of the values does not exceed."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def quantile_of_ages(ages, share):
    """The same of a histogram: upper bounds and counts in ascending order."""
    left = share * sum(count for _, count in ages)
    for upper, count in ages:
        left -= count
        if left <= 0:
            return upper
    sys.exit("no sample was received: no figures")


def table(titles, rows):
    """Prints columns: the first to the left, the others to the right."""
    lines = [[str(cell) for cell in line] for line in (titles, *rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for first, *others in lines:
        print(first.ljust(widths[0]) + "".join(f"  {cell:>{width}}" for cell, width in zip(others, widths[1:])), flush=True)


def sides_table(title, figures, sides, over=None):
    """Prints a row a figure and a column a side. `figures` have title, unit and decimals; `over` are ratios, by side."""
    over = over or {}
    titles = [title]
    for side in sides:
        titles += [side, "ratio", "least..most"] if side in over else [side]
    rows = []
    for figure, (name, unit, decimals) in figures.items():
        row = [name]
        for side, found in sides.items():
            row.append(f"{found[figure]:.{decimals}f} {unit}".strip() if figure in found else "")
            if side in over:
                row += ratio_cells(over[side].get(figure))
        rows.append(row)
    print()
    table(titles, rows)


def ratio_cells(ratio):
    if ratio is None:
        return ["", ""]
    return [f"{ratio[0]:.2f}", f"{ratio[1]:.2f}..{ratio[2]:.2f}"]
