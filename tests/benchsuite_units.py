"""Tests of what the subjects of scripts/benchsuite share. Run by tests/tidy/benchsuite.rs:

    python3 tests/benchsuite_units.py
"""

import sys
import tempfile
import unittest
from pathlib import Path

sys.dont_write_bytecode = True
sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benches"))

from suite import figures, graphs, page, time_step  # noqa: E402
from suite.options import Option  # noqa: E402

TABLE = """# Benchmarks

Before.

| figure | peer | ratio | before | measured |
|---|---|---|---|---|
| a hull | Qhull | 0.10 | - | 2026-01-02, 2 cores |
| a chain | five processes | 1.20 | 1.10 | 2026-01-02, 2 cores |

Behind.
"""


class Figures(unittest.TestCase):
    def test_a_quantile_is_the_least_value_that_the_share_does_not_exceed(self):
        values = [30, 10, 20, 40]
        self.assertEqual([figures.quantile(values, share) for share in (0, 0.25, 0.5, 0.51, 1)], [10, 10, 20, 30, 40])
        self.assertEqual(figures.quantile_of_ages([(10, 1), (20, 2), (40, 1)], 0.5), 20)

    def test_sides_run_in_turn_and_ratios_are_of_the_same_round(self):
        order, values = [], {"bare": iter([1.0, 10.0, 2.0]), "graph": iter([2.0, 30.0, 2.0])}

        def side(name):
            order.append(name)
            return {"secs": next(values[name]), "lost": 0}

        runs = figures.in_turn(3, {name: lambda name=name: side(name) for name in values})
        self.assertEqual(order, ["bare", "graph"] * 3)
        self.assertEqual(figures.medians(runs), {"bare": {"secs": 2.0, "lost": 0}, "graph": {"secs": 2.0, "lost": 0}})
        # A figure that is 0 on the other side has no ratio.
        self.assertEqual(figures.ratios(runs, "bare"), {"graph": {"secs": [2.0, 1.0, 3.0]}})


class Page(unittest.TestCase):
    def test_a_run_is_compared_with_the_page_and_moves_its_ratio_to_before(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "benchmarks.md"
            path.write_text(TABLE)
            rows, compared = page.compare([("a hull", "Qhull", 0.131), ("a chain", "five processes", 1.7)], path)
            self.assertEqual([row["is_slower"] for row in compared], [False, True])
            page.write(rows, path)
            text = path.read_text()
        self.assertTrue(text.startswith("# Benchmarks\n\nBefore.\n\n| figure |") and text.endswith("|\n\nBehind.\n"), text)
        self.assertIn("| a hull | Qhull | 0.13 | 0.10 |", text)
        self.assertIn("| a chain | five processes | 1.70 | 1.20 |", text)

    def test_the_page_of_the_project_can_be_written(self):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "benchmarks.md"
            path.write_text(page.PAGE.read_text())
            page.write(page.read(path), path)
            self.assertEqual(path.read_text(), page.PAGE.read_text())


class Options(unittest.TestCase):
    def test_the_default_says_what_an_option_is(self):
        self.assertEqual(Option((100.0,), "", least=10).parse("10,2000"), (10.0, 2000.0))
        self.assertEqual(Option(3, "").parse("7"), 7)
        self.assertRaises(ValueError, Option(3, "").parse, "7.5")
        self.assertFalse(Option((100.0,), "", least=10).is_allowed((100.0, 9.0)))


class Graphs(unittest.TestCase):
    def test_nodes_of_the_default_graph_get_lines_of_their_own(self):
        nodes = graphs.default_nodes()
        with tempfile.TemporaryDirectory() as folder:
            text = graphs.default_with(Path(folder), {nodes[1]: ["group: judge", "heartbeat_ms: 500"]}).read_text()
        self.assertIn(f"\n  {nodes[1]}:\n    group: judge\n    heartbeat_ms: 500\n", text)
        self.assertEqual(text.count("group: judge"), 1)

    def test_a_recording_fills_the_time(self):
        # 41 grasps of 23 periods at 1 kHz take 0.943 s.
        self.assertEqual(graphs.repeats(41, 1000, 9.43), 10)
        self.assertEqual(graphs.repeats(41, 1000, 0.1), 1)


class Lifts(unittest.TestCase):
    def test_lifts_of_the_same_candidate_are_compared(self):
        found = time_step.compare({1: True, 2: True, 3: False, 4: False}, {2: False, 3: True, 4: False, 5: True})
        self.assertEqual(list(found.values()), [3, 1, 1, 1, 1])


if __name__ == "__main__":
    unittest.main()
