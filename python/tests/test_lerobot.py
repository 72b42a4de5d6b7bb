"""Tests of blindgrasp.lerobot, with small datasets of the formats v2.1 and v3.0, and the import of the program."""

import csv
import importlib.util
import io
import json
import os
import shlex
import subprocess
import sys
import tempfile
import unittest
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

import blindgrasp
import numpy as np
from blindgrasp import lerobot

PACKAGE = Path(blindgrasp.__file__).resolve().parents[1]
FPS, N_FRAMES, N_EPISODES = 10, 30, 12
TASKS = ["pick up the mug, gently", "pick up the can — and put it down again on the table of the other robot"]
STATE = ["arm.pos", "jaw.pos"]

FEATURES = {
    "observation.state": {"dtype": "float32", "shape": [2], "names": {"motors": STATE}},
    "observation.tactile.left": {"dtype": "int16", "shape": [4, 3], "names": ["rows", "columns"]},
    # x, y and z of each cell.
    "observation.tactile.right": {"dtype": "float32", "shape": [36], "names": None},
    "observation.images.front": {"dtype": "video", "shape": [3, 8, 8], "names": ["c", "h", "w"]},
    "observation.image": {"dtype": "image", "shape": [3, 8, 8]},
    "next.success": {"dtype": "bool", "shape": [1], "names": None},
    "subtask": {"dtype": "string", "shape": [1], "names": None},
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), {"dtype": "int64", "shape": [1], "names": None}),
}


def is_kept(episode):
    return episode % 3 > 0


def jaw(episode, frame):
    """The jaw of the gripper, in per cent of its way."""
    return 100 - (episode + frame)


def episode_frames(episode):
    """The columns of an episode."""
    frames = range(N_FRAMES)
    return {
        "observation.state": [[0.5, float(jaw(episode, frame))] for frame in frames],
        "observation.tactile.left": [(np.arange(12).reshape(4, 3) + episode + frame).tolist() for frame in frames],
        "observation.tactile.right": [
            [axis + cell / 8 + frame for cell in range(12) for axis in (-50.0, -40.0, 0.0)] for frame in frames
        ],
        "observation.image": [{"bytes": b"image", "path": None}] * N_FRAMES,
        # The object is held from the lift on, and its end counts.
        "next.success": [frame > 20 and (frame < N_FRAMES - 1 or is_kept(episode)) for frame in frames],
        "subtask": ["reach"] * 8 + ["grasp"] * 7 + ["lift"] * 10 + ["grasp"] * 5,
        "timestamp": [frame / FPS for frame in frames],
        "frame_index": list(frames),
        "episode_index": [episode] * N_FRAMES,
        "index": [episode * N_FRAMES + frame for frame in frames],
        "task_index": [episode % 2] * N_FRAMES,
    }


@unittest.skipUnless(importlib.util.find_spec("pyarrow"), "the package pyarrow is not installed: pip install pyarrow")
class LeRobot(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        self.table = self.folder / "table.csv"

    def write_parquet(self, path, columns, types=()):
        import pyarrow
        import pyarrow.parquet

        path.parent.mkdir(parents=True, exist_ok=True)
        types = dict(types) | {"observation.tactile.left": pyarrow.list_(pyarrow.list_(pyarrow.int16()))}
        types |= {"observation.state": pyarrow.list_(pyarrow.float32(), 2), "timestamp": pyarrow.float32()}
        arrays = {name: pyarrow.array(values, types.get(name)) for name, values in columns.items()}
        pyarrow.parquet.write_table(pyarrow.table(arrays), path, row_group_size=N_FRAMES)

    def dataset(self, version, change=lambda episode, columns: None, **info):
        """A dataset of the version; `change` changes the columns of an episode."""
        root = self.folder / version
        episodes = [episode_frames(episode) for episode in range(N_EPISODES)]
        for episode, columns in enumerate(episodes):
            change(episode, columns)
        fields = [
            {"episode_index": episode, "tasks": [TASKS[episode % 2]], "session": f"2026-11-{episode // 6 + 1:02}"}
            for episode in range(N_EPISODES)
        ]
        (root / "meta").mkdir(parents=True)
        if version.startswith("v2."):
            data_path = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
            for episode, columns in enumerate(episodes):
                self.write_parquet(root / data_path.format(episode_chunk=episode // 5, episode_index=episode), columns)
            tasks = [{"task_index": idx, "task": task} for idx, task in enumerate(TASKS)]
            for name, rows in (("episodes", fields), ("tasks", tasks)):
                text = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows)
                (root / f"meta/{name}.jsonl").write_text(text, encoding="utf-8")
        else:
            data_path = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
            # The last 4 episodes are in a second file, as their fields are.
            for file, begin, end in ((0, 0, 8), (1, 8, N_EPISODES)):
                columns = {name: sum((episode[name] for episode in episodes[begin:end]), []) for name in episodes[0]}
                self.write_parquet(root / data_path.format(chunk_index=0, file_index=file), columns)
                rows = [
                    row | {"data/chunk_index": 0, "data/file_index": file, "stats/action/min": [0.0]} for row in fields[begin:end]
                ]
                path = root / f"meta/episodes/chunk-000/file-{file:03d}.parquet"
                self.write_parquet(path, {name: [row[name] for row in rows] for name in rows[0]})
            self.write_parquet(root / "meta/tasks.parquet", {"task_index": [0, 1], "__index_level_0__": TASKS})
        info = {"codebase_version": version, "fps": FPS, "chunks_size": 5, "data_path": data_path, "features": FEATURES} | info
        (root / "meta/info.json").write_text(json.dumps(info))
        return root

    def convert(self, root, *words, cells="observation.tactile.left,observation.tactile.right/2::3", label="next.success"):
        # As python -m blindgrasp.lerobot; to start Python and read pyarrow each time would take longer than a conversion.
        command = ["lerobot", str(root), str(self.table), "--cells", cells, "--label", label]
        # The jaw opens 0.0425 m at 100 %.
        command += ["--hand", "parallel-gripper", "--joints", "observation.state/jaw*", "--joint-scale", "0.000425", *words]
        stdout, stderr = io.StringIO(), io.StringIO()
        with mock.patch.object(sys, "argv", command), redirect_stdout(stdout), redirect_stderr(stderr):
            exit_code = lerobot.main()
        return subprocess.CompletedProcess(command, exit_code, stdout.getvalue(), stderr.getvalue())

    def converted(self, *arguments, **given):
        done = self.convert(*arguments, **given)
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertEqual([path.name for path in self.folder.glob(".*")], [])
        return done

    def imported(self, done):
        """The grasps that the import reads, by the command that was printed."""
        command = shlex.split(done.stdout.splitlines()[-1])
        self.assertEqual(command[:2], ["blindgrasp", "import"])
        imported = subprocess.run([str(blindgrasp.program()), *command[1:], "--overwrite"], capture_output=True, text=True)
        self.assertEqual(imported.returncode, 0, imported.stderr)
        return blindgrasp.read(command[command.index("--out") + 1])

    def rows(self):
        with self.table.open(encoding="utf-8", newline="") as stream:
            return list(csv.DictReader(stream))

    def refused(self, words, *arguments, **given):
        done = self.convert(*arguments, **given)
        self.assertEqual(done.returncode, 1, done.stderr)
        self.assertRegex(done.stderr, words)
        self.assertFalse(self.table.exists())
        self.assertEqual([path.name for path in self.folder.glob(".*")], [])

    def test_a_dataset_of_each_format_is_imported(self):
        tables = []
        for version in ("v2.0", "v2.1", "v3.0"):
            with self.subTest(version):
                done = self.converted(self.dataset(version), "--at", "1.4", "--day", "session", "--overwrite")
                # A slow machine tells how far it is.
                self.assertRegex(done.stderr, r"\A(\d+ of 12 episodes\n)*\Z")
                self.assertIn("12 grasps of 12 episodes", done.stdout)
                grasps = self.imported(done)
                self.assertEqual(len(grasps), N_EPISODES)
                for episode, grasp in enumerate(grasps):
                    self.assertEqual((grasp.grasp_id, grasp.label.is_stable), (episode, is_kept(episode)))
                    self.assertEqual(grasp.phase.tolist(), ["settled"] * 3)
                    for frame, joint, cells in zip((12, 13, 14), grasp.joints, grasp.cells_newtons, strict=True):
                        np.testing.assert_allclose(joint, [jaw(episode, frame) * 0.000425], rtol=1e-6)
                        right = [cell / 8 + frame for cell in range(12)]
                        np.testing.assert_allclose(cells, [*np.arange(12) + episode + frame, *right], rtol=1e-6)
                objects = [grasp.label.object_id for grasp in grasps[:2]]
                self.assertEqual(objects[0], TASKS[0])
                # The import takes 64 bytes of a name.
                self.assertRegex(objects[1], "^pick up the can — and put it down again on the tab.*~[0-9a-f]{8}$")
                self.assertEqual({row["day"] for row in self.rows()}, {"2026-11-01", "2026-11-02"})
                tables.append(self.table.read_text(encoding="utf-8"))
        self.assertEqual(len(set(tables)), 1)

    def test_a_written_dataset_has_the_layout_of_v3_and_is_read_back_unchanged(self):
        import pandas as pd

        recordings = [PACKAGE.parent / f"recordings/{name}.mcap" for name in ("ordinary", "no-contact")]
        grasps = [grasp for path in recordings for grasp in blindgrasp.read(path)]
        root = self.folder / "written"
        blindgrasp.to_lerobot(recordings, root, hand="barrett-bh8-280")
        info = json.loads((root / "meta/info.json").read_text())
        sums = {name: info[f"total_{name}"] for name in ("episodes", "frames", "tasks")}
        self.assertEqual(sums, {"episodes": 24, "frames": 24 * 14, "tasks": len({grasp.label.object_id for grasp in grasps})})
        self.assertEqual((info["fps"], info["codebase_version"], info["splits"]), (100, "v3.0", {"train": "0:24"}))
        tactile = info["features"]["observation.tactile"]
        self.assertEqual((tactile["dtype"], tactile["shape"], tactile["names"][25]), ("float64", [96], "cell_finger_1_1"))
        tasks = pd.read_parquet(root / "meta/tasks.parquet")
        episodes = pd.read_parquet(root / "meta/episodes")
        frames = pd.concat(map(pd.read_parquet, sorted(root.glob("data/*/*.parquet"))))
        self.assertEqual(set(frames.columns), set(info["features"]))
        self.assertEqual(frames["index"].tolist(), list(range(24 * 14)))
        for (_, episode), grasp in zip(episodes.iterrows(), grasps, strict=True):
            rows = frames[episode["dataset_from_index"] : episode["dataset_to_index"]]
            self.assertEqual(set(rows["episode_index"]), {episode["episode_index"]})
            self.assertEqual(tasks.index[rows["task_index"].iloc[0]], grasp.label.object_id)
            self.assertEqual(episode["tasks"].tolist(), [grasp.label.object_id])
            np.testing.assert_array_equal(np.stack(rows["observation.tactile"]), grasp.cells_newtons)
            np.testing.assert_allclose(rows["timestamp"], np.arange(14) / 100, atol=1e-6)
            mean = episode["stats/observation.tactile/mean"]
            np.testing.assert_allclose(mean, grasp.cells_newtons.mean(axis=0), atol=1e-9)
        cells = np.concatenate([grasp.cells_newtons for grasp in grasps])
        stats = json.loads((root / "meta/stats.json").read_text())["observation.tactile"]
        for name, expected in (("mean", cells.mean(axis=0)), ("std", cells.std(axis=0)), ("max", cells.max(axis=0))):
            np.testing.assert_allclose(stats[name], expected, atol=1e-9)
        again = blindgrasp.from_parquet(root, self.folder / "again")
        self.assertEqual([recording.path.name for recording in again], [path.name for path in recordings])
        for grasp, copied in zip(grasps, (grasp for recording in again for grasp in recording), strict=True):
            for name in ("seq", "stamp_nanos", "joints", "cells_newtons", "phase"):
                np.testing.assert_array_equal(getattr(copied, name), getattr(grasp, name))
            self.assertEqual((copied.label, copied.epoch, copied.day), (grasp.label, grasp.epoch, grasp.day))
        # LeRobot's own splits drop the fields of episodes.
        episodes.drop(columns="stable").to_parquet(root / "meta/episodes/chunk-000/file-000.parquet")
        with self.assertRaisesRegex(ValueError, "file-000.parquet: .* it has no 'stable'"):
            blindgrasp.from_parquet(root, self.folder / "more")
        words = ["--hand", "barrett-bh8-280", "--joints", "observation.state", "--joint-scale", "1", "--settled", "phase=settled"]
        done = self.converted(root, *words, cells="observation.tactile", label="stable")
        for grasp, copied in zip(grasps, self.imported(done), strict=True):
            np.testing.assert_array_equal(copied.cells_newtons, grasp.cells_newtons[grasp.phase == "settled"][-3:])
            self.assertEqual((copied.label.is_stable, copied.label.object_id), (grasp.label.is_stable, grasp.label.object_id))
        with self.assertRaises(FileExistsError):
            blindgrasp.to_lerobot(recordings, root)

    def test_the_settled_frames_are_the_first_with_a_value_or_end_at_a_moment_of_the_user(self):
        root = self.dataset("v3.0")
        last = lambda: {int(row["grasp"]): float(row["cells1.0"]) - int(row["grasp"]) for row in self.rows()}  # noqa: E731
        self.converted(root, "--settled", "subtask=grasp", "--frames", "2")
        self.assertEqual((len(self.rows()), set(last().values())), (24, {14.0}))
        self.converted(root, "--at", "-1", "--overwrite")
        self.assertEqual(set(last().values()), {N_FRAMES - 1 - FPS})
        fields = self.folder / "fields.csv"
        # Episode 3 has no moment, and the moment of episode 4 is after its end.
        moments = {3: "", 4: "99"}
        lines = [f"{episode},{moments.get(episode, 1 + episode / 10)},{episode % 2}\n" for episode in range(N_EPISODES)]
        fields.write_text("episode_index,seconds,kept\n" + "".join(lines))
        words = ["--episodes", str(fields), "--at", "seconds", "--stable-value", "1", "--overwrite"]
        done = self.converted(root, *words, label="kept")
        self.assertEqual(last(), {episode: 10 + episode for episode in range(N_EPISODES) if episode not in moments})
        self.assertIn("1 of 12 episodes left out: no value of 'seconds' (--at)", done.stderr)
        self.assertIn("1 of 12 episodes left out: --at seconds is outside of the episode", done.stderr)
        grasps = self.imported(done)
        kept = [int(row["grasp"]) % 2 > 0 for row in self.rows()[::3]]
        self.assertEqual([grasp.label.is_stable for grasp in grasps], kept)

    def test_episodes_without_label_are_left_out_and_counted(self):
        def no_label(episode, columns):
            if episode in (2, 5):
                columns["next.success"][-1] = None

        done = self.converted(self.dataset("v2.1", no_label), "--at", "1", "--object", "subtask")
        self.assertIn("2 of 12 episodes left out: no value of 'next.success' (--label)", done.stderr)
        self.assertIn("all grasps have the object 'grasp'", done.stderr)
        self.assertEqual(len(self.imported(done)), N_EPISODES - 2)

    def test_joints_may_have_a_scale_and_an_offset_each(self):
        words = ["--at", "1", "--joints", "observation.state/1,observation.state/arm.pos"]
        self.converted(self.dataset("v2.1"), *words, "--joint-scale", "0.01,2", "--joint-offset=-1,0.5")
        row = self.rows()[0]
        self.assertAlmostEqual(float(row["joints1.1.jaw_pos"]), -0.08)
        self.assertEqual(row["joints2.0.arm_pos"], "1.5")
        done = self.converted(self.folder / "v2.1", "--at", "1", "--joints", "", "--joint-scale", "1", "--overwrite")
        self.assertIn(" --joints NAME=VALUE ", done.stdout)

    def test_bad_values_are_refused_or_left_out(self):
        def bad(episode, columns):
            if episode == 1:
                columns["observation.tactile.right"][10][35] = float("nan")
            if episode == 2:
                columns["observation.tactile.left"][9].pop()
            if episode == 4:
                columns["observation.tactile.right"][10][0] = float("nan")

        for version in ("v2.1", "v3.0"):
            root = self.dataset(version, bad)
            words = "parquet: episode 1: frame 10: observation.tactile.right: expected numbers, found nan in element 35"
            self.refused(words, root, "--at", "1")
            done = self.converted(root, "--at", "1", "--skip-bad")
            self.assertIn("episode 2: frame 9: observation.tactile.left: expected 12 numbers", done.stderr)
            self.assertIn("2 of 12 episodes left out: bad values", done.stderr)
            # x of a cell is not read.
            self.assertEqual(len(self.imported(done)), N_EPISODES - 2)
            self.table.unlink()

    def test_what_cannot_be_used_is_said(self):
        root, at = self.dataset("v3.0"), ("--at", "1")
        known = "features: observation.state, observation.tactile.left, observation.tactile.right, next.success"
        fields = self.folder / "fields.csv"
        fields.write_text("episode_index,kept\n77,1\n")
        for words, more, given in (
            (f"info.json: --cells: found no 'touch', .* expected one of: {known[10:]}", at, {"cells": "touch"}),
            ("--cells: found no 'observation.images.front', or only images", at, {"cells": "observation.images.front"}),
            ("--joints: found no element 'x'.* names: arm.pos, jaw.pos", (*at, "--joints", "observation.state/x"), {}),
            ("--joints: found no element '2'", (*at, "--joints", "observation.state/2"), {}),
            ("--label: found no 'kept'.*fields of episodes: .*session", at, {"label": "kept"}),
            ("--settled FEATURE=VALUE: found no 'phase'", ("--settled", "phase=2"), {}),
            ("--joint-scale.* one for each of 1 joints", (*at, "--joint-scale", "1,2,3"), {}),
            ("--joint-scale.*could not convert", (*at, "--joint-scale", "x"), {}),
            ("--label next.success: .*one of them '1' .*found 'false' in 4, 'true' in 8", (*at, "--stable-value", "1"), {}),
            ("found no episodes", ("--at", "9"), {}),
            ("found no episodes", ("--settled", "subtask=pour"), {}),
            ("--at session: expected seconds", ("--at", "session"), {}),
            ("--frames: expected 1 or more", (*at, "--frames", "0"), {}),
            ("fields.csv: expected CSV.*found: no 77", (*at, "--episodes", str(fields)), {}),
            ("none.csv: expected CSV", (*at, "--episodes", str(self.folder / "none.csv")), {}),
        ):
            with self.subTest(words):
                self.refused(words, root, *more, **given)
        self.table.mkdir()
        done = self.convert(root, *at, "--overwrite")
        self.assertEqual(done.returncode, 1)
        self.assertIn("table.csv: expected a file that can be written", done.stderr)
        self.table.rmdir()
        self.table.write_text("mine")
        done = self.convert(root, *at)
        self.assertEqual((done.returncode, self.table.read_text()), (1, "mine"))
        self.assertIn("--overwrite", done.stderr)

    def test_damaged_datasets_are_told(self):
        self.refused("info.json: expected a LeRobot dataset.*No such file", self.folder / "none", "--at", "1")
        root = self.dataset("v2.1")
        info, episodes, tasks = (root / "meta" / name for name in ("info.json", "episodes.jsonl", "tasks.jsonl"))
        data = root / "data/chunk-000/episode_000003.parquet"
        other = lambda **changed: json.dumps(json.loads(info.read_text()) | changed)  # noqa: E731
        for path, content, words in (
            (info, "{", "info.json: expected a LeRobot dataset's JSON"),
            (info, "[]", "info.json: expected a LeRobot dataset's JSON"),
            (info, '{"codebase_version": "v2.1"}', "info.json: expected .*; found: no 'data_path'"),
            (info, other(codebase_version="v1.6"), "expected format v2.0, v2.1 or v3.0, found v1.6"),
            (info, other(data_path="data/{x}.parquet"), "expected fields like .* in data_path, found 'data/{x}.parquet'"),
            # Each would take 2 GB for a name.
            (info, other(data_path="{episode_index:>2000000000}"), "expected fields like .* in data_path"),
            (info, other(data_path="{episode_index:{episode_index}}"), "expected fields like .* in data_path"),
            (info, other(data_path="{episode_index.real}"), "expected fields like .* in data_path"),
            (info, other(features={"state": {"dtype": "float32", "shape": [1 << 31]}}), "at most 1000000 elements"),
            (info, other(features={"state": {"dtype": "float32"}}), "found: no 'shape'"),
            (episodes, episodes.read_text() + "{\n", "episodes.jsonl, line 13: expected JSON"),
            (episodes, '{"tasks": []}\n', "episodes.jsonl: expected a whole number episode_index .*found: no 'episode_index'"),
            (episodes, "", "meta: expected episodes, found none"),
            (episodes, b"\xff\xfe", "episodes.jsonl: expected a whole number episode_index"),
            (tasks, '{"task_index": 0, "task": "x"}\n', "episode 1: expected a name in 'task' .*found none"),
            (tasks, "{}\n", "tasks.jsonl: expected task_index and task"),
            (data, "version https://git-lfs.github.com/spec/v1", "3.parquet: expected a Parquet file .git lfs pull"),
            (data, data.read_bytes()[:3000], "episode_000003.parquet: expected a Parquet file"),
            (data, None, "episode_000003.parquet: expected a file, found none: download"),
        ):
            with self.subTest(words):
                whole = path.read_bytes()
                if content is None:
                    path.unlink()
                else:
                    path.write_bytes(content if isinstance(content, bytes) else content.encode())
                self.refused(words, root, "--at", "1")
                path.write_bytes(whole)
        whole = info.read_bytes()
        info.unlink()
        info.symlink_to("/dev/zero")
        self.refused("info.json: expected a LeRobot dataset's JSON .*found: no regular file", root, "--at", "1")
        info.unlink()
        info.write_bytes(whole)
        self.write_parquet(data, {name: values for name, values in episode_frames(3).items() if name != "next.success"})
        self.refused("episode_000003.parquet: expected a column 'next.success'; found columns: ", root, "--at", "1")
        self.write_parquet(data, episode_frames(4))
        self.refused("episode_000003.parquet: episode 3: expected frames, found none", root, "--at", "1")

    def test_a_missing_pyarrow_is_told(self):
        (self.folder / "pyarrow.py").write_text("raise ImportError('none here')")
        code = f"import sys; sys.path.insert(0, {str(self.folder)!r}); import blindgrasp.lerobot as it; sys.exit(it.main())"
        command = [sys.executable, "-c", code, "dataset", str(self.table), "--cells", "x", "--label", "y", "--at", "1"]
        done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(PACKAGE)})
        self.assertEqual((done.returncode, "Traceback" in done.stderr), (1, False))
        self.assertIn("pip install pyarrow", done.stderr)

    def test_the_help_says_what_is_assumed(self):
        done = subprocess.run(
            [sys.executable, "-m", "blindgrasp.lerobot", "--help"],
            capture_output=True, text=True, check=True, env=os.environ | {"PYTHONPATH": str(PACKAGE)},
        )  # fmt: skip
        self.assertIn("the lift must not have begun", done.stdout)


if __name__ == "__main__":
    unittest.main()
