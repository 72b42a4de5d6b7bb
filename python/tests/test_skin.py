"""Tests of `blindgrasp.skin`: the cells of a hand in a user's own MuJoCo model."""

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import unittest
from pathlib import Path

import blindgrasp
import numpy as np

REPOSITORY = Path(__file__).resolve().parents[2]
GRIPPER = REPOSITORY / "hands/parallel-gripper.yaml"

# A Python for the simulator: it runs MuJoCo's program, and writes what the skin reads whenever that program is asked for
# the contacts. The simulator places links as they are after a step, MuJoCo's data has them before it: mj_kinematics.
READER = """#!{python}
import json, sys
script = sys.argv[2]
assert script.endswith("\\nmain()\\n")
scope = {{}}
exec(script.removesuffix("main()\\n"), scope)
import blindgrasp, mujoco
touches = scope["Attempt"].touches
links = {{"distal_1": "body1", "distal_2": "body3", "distal_3": "body5"}}
def read(attempt):
    if not hasattr(attempt, "skin"):
        attempt.skin = blindgrasp.skin(attempt.model, "barrett-bh8-280", links, bell_m=0.003, kept=0.6)
    mujoco.mj_kinematics(attempt.model, attempt.data)
    with open("readings", "a") as file:
        print(json.dumps(attempt.skin.read(attempt.data).tolist()), file=file)
    return touches(attempt)
scope["Attempt"].touches = read
scope["main"]()
"""
OPTIONS = """sensor:
  noise_newtons: 0
  counts_per_newton_per_cm2: 1.0e+6
  largest_count: 4294967295
  skin: {bell_share: 1, bell_m: [0.003, 0.003], kept: [0.6, 0.6]}
"""


def squeezed(**mapping):
    """A gripper that presses on a fixed box, 0.3 s after it has begun."""
    import mujoco

    names = {name: mapping.pop(name, name) for name in ("left_jaw", "right_jaw")}
    spec = mujoco.MjSpec.from_file(str(GRIPPER.with_suffix(".urdf")))
    spec.compiler.fusestatic = False
    for link, name in names.items():
        spec.body(link).name = name
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.006, 0.02, 0.012], pos=[0.001, 0, 0.04])
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0201
    data.qfrc_applied[:] = -3.0
    mujoco.mj_step(model, data, 300)
    return model, data


@unittest.skipUnless(importlib.util.find_spec("mujoco"), "the package mujoco is not installed")
class Skin(unittest.TestCase):
    def test_the_cells_are_those_of_simulate_in_mujoco(self):
        with tempfile.TemporaryDirectory() as folder:
            folder = Path(folder)
            (folder / "options.yaml").write_text(OPTIONS)
            (folder / "python").write_text(READER.format(python=sys.executable))
            (folder / "python").chmod(0o755)
            command = [blindgrasp.program(), *"simulate --label lift --physics mujoco --protocol planned".split()]
            command += "--objects box-00 --grasps 1 --stable-fraction natural --seed 1".split()
            command += "--options options.yaml --out lift.mcap".split()
            # The process that runs MuJoCo finds this package and this program.
            places = [str(Path(blindgrasp.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
            environment = os.environ | {
                "BLINDGRASP_PYTHON": str(folder / "python"),
                "BLINDGRASP_PROGRAM": str(blindgrasp.program()),
                "PYTHONPATH": os.pathsep.join(places),
            }
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
            self.assertEqual(done.returncode, 0, done.stderr)
            (grasp,) = blindgrasp.read(folder / "lift.mcap")
            read = np.array([json.loads(line) for line in (folder / "readings").read_text().splitlines()])
        # The simulator asks for contacts at other times, too. Its readings are multiples of 1e-6 N/cm².
        for cells in grasp.cells_newtons:
            self.assertLess(np.abs(read - cells).max(axis=1).min(), 1e-6)
        settled = grasp.cells_newtons[grasp.phase == "settled"]
        self.assertTrue(np.all(np.sum(settled > 0.1, axis=1) > 20), settled)

    def test_cells_of_a_users_model_feel_its_contacts(self):
        import mujoco

        model, data = squeezed()
        cells = blindgrasp.skin(model, GRIPPER).read(data)
        pressed = dict.fromkeys(["left_jaw", "right_jaw"], 0.0)
        force = np.zeros(6)
        for idx, contact in enumerate(data.contact):
            mujoco.mj_contactForce(model, data, idx, force)
            for geom in contact.geom:
                name = model.body(model.geom_bodyid[geom]).name
                if name in pressed:
                    pressed[name] += force[0]
        # The corners of the box lie between cells, whose neighbours feel all of their force.
        self.assertAlmostEqual(pressed["left_jaw"], 3.0, delta=0.1)
        np.testing.assert_allclose([cells[:12].sum(), cells[12:].sum()], list(pressed.values()), rtol=1e-9)
        self.assertTrue(np.all(cells > 0.0), cells)
        # MuJoCo's other cone, after the same step.
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        mujoco.mj_forward(model, data)
        other = blindgrasp.skin(model, GRIPPER).read(data)
        self.assertAlmostEqual(other.sum(), cells.sum(), delta=0.1)
        # A bell that loses what falls beside cells.
        self.assertLess(blindgrasp.skin(model, GRIPPER, kept=0.0).read(data).sum(), 0.9 * other.sum())
        mujoco.mj_resetData(model, data)
        self.assertEqual(blindgrasp.skin(model, GRIPPER).read(data).sum(), 0.0)

    def test_links_are_bodies_or_sites_with_other_names(self):
        import mujoco

        model, data = squeezed()
        expected = blindgrasp.skin(model, GRIPPER).read(data)
        renamed = squeezed(left_jaw="a", right_jaw="b")[0]
        read = blindgrasp.skin(renamed, GRIPPER, {"left_jaw": "a", "right_jaw": "b"}).read(data)
        np.testing.assert_array_equal(read, expected)
        attached = squeezed(left_jaw="my_left_jaw", right_jaw="my_right_jaw")[0]
        read = blindgrasp.skin(attached, GRIPPER, prefix="my_").read(data)
        np.testing.assert_array_equal(read, expected)
        with self.assertRaisesRegex(ValueError, "no body and no site 'left_jaw' for link 'left_jaw' .* 'a', 'b'"):
            blindgrasp.skin(renamed, GRIPPER)
        with self.assertRaisesRegex(ValueError, "links names 'palm', which has no cells: expected any of 'left_jaw'"):
            blindgrasp.skin(model, GRIPPER, {"palm": "palm"})
        # The jaw hangs on another body, whose frame a site corrects; its shape is on a body that is fixed to that one.
        moved = """<mujoco><worldbody><body pos="0.3 0 0"><joint type="slide"/>
            <body name="left_jaw" pos="0 0 0.5"><site name="frame" pos="0 0 -0.5"/>
            <body><geom type="box" size="0.011 0.006 0.029" pos="0 0.006 -0.469"/></body></body></body>
            <body name="right_jaw"><geom type="box" size="0.011 0.006 0.029" pos="0 -0.006 0.031"/></body>
            <geom type="box" size="0.006 0.02 0.012" pos="0.3 -0.0199 0.04"/></worldbody></mujoco>"""
        model = mujoco.MjModel.from_xml_string(moved)
        with self.assertRaisesRegex(ValueError, "'left_jaw' lies 4.. mm beside all shapes .* name in links a site"):
            blindgrasp.skin(model, GRIPPER)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        cells = blindgrasp.skin(model, GRIPPER, {"left_jaw": "frame"}).read(data)
        self.assertTrue(np.all(cells[:12] > 0.0) and np.all(cells[12:] == 0.0), cells)

    def test_readings_differ_from_forces_only_as_asked(self):
        model, data = squeezed()
        exact = blindgrasp.skin(model, GRIPPER).forces(data)

        def read(secs=(0.0,), **options):
            skin = blindgrasp.skin(model, GRIPPER, **options)
            for at in secs:
                data.time = at
                cells = skin.read(data)
            return cells

        np.testing.assert_array_equal(read(), exact)
        gains = read(gain_sigma=0.1, seed=1) / exact
        self.assertTrue(0.05 < np.log(gains).std() < 0.2, gains)
        np.testing.assert_array_equal(read(gain_sigma=0.1, seed=1) / exact, gains)
        self.assertEqual(len({*np.round(read(common_gain_sigma=0.2) / exact, 9)}), 1)
        # Cells that have felt nothing before, after one time constant.
        np.testing.assert_allclose(read([0.0, 0.03], lag_secs=0.03), exact * (1 - np.exp(-1)))
        np.testing.assert_allclose(read([0.0, 5.0], creep=0.1), exact * (1 + 0.1 * (1 - np.exp(-1))))
        # The clock goes back: the model was reset.
        np.testing.assert_array_equal(read([0.0, 1.0, 0.5], lag_secs=0.03), 0.0 * exact)
        threshold = np.median(exact)
        np.testing.assert_array_equal(read(threshold_newtons=threshold), np.where(exact < threshold, 0.0, exact))
        skin = blindgrasp.skin(model, GRIPPER, glitch_share=0.03, glitch_newtons=0.4, seed=2)
        spikes = np.array([skin.read(data) - exact for _ in range(500)])
        self.assertTrue(np.all(spikes >= 0.0) and 0.02 < np.mean(spikes > 0.0) < 0.04)
        # The mean of the absolute value of a normal number.
        self.assertAlmostEqual(spikes[spikes > 0.0].mean(), 0.4 * np.sqrt(2 / np.pi), delta=0.04)
        noise = read(noise_newtons=0.01) - exact
        self.assertTrue(0.0 < np.abs(noise).max() < 0.05, noise)
        for wrong in ({"kept": 1.5}, {"bell_m": 0.0}, {"lag_secs": -1.0}, {"noise_newtons": np.nan}):
            ((name, _),) = wrong.items()
            with self.assertRaisesRegex(ValueError, f"{name} is .*, expected"):
                blindgrasp.skin(model, GRIPPER, **wrong)

    def test_a_reset_begins_at_rest_the_cone_may_change_and_bodies_may_not_sleep(self):
        import mujoco

        model, data = squeezed()
        skin = blindgrasp.skin(model, GRIPPER, lag_secs=0.02)
        skin.read(data)
        data.time += 1.0
        self.assertGreater(skin.read(data).max(), 0.1)
        skin.reset()
        np.testing.assert_array_equal(skin.read(data), 0.0)
        forces = {}
        for cone in (mujoco.mjtCone.mjCONE_PYRAMIDAL, mujoco.mjtCone.mjCONE_ELLIPTIC):
            model.opt.cone = cone
            mujoco.mj_forward(model, data)
            forces[cone] = skin.forces(data)
            np.testing.assert_array_equal(forces[cone], blindgrasp.skin(model, GRIPPER).forces(data))
        # Older versions of MuJoCo have no sleep.
        model.opt.enableflags |= getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0)
        if not model.opt.enableflags:
            return
        with self.assertRaisesRegex(ValueError, "may sleep, .* expected it without mjENBL_SLEEP"):
            blindgrasp.skin(model, GRIPPER)
        with self.assertRaisesRegex(ValueError, "may sleep"):
            skin.read(data)

    def test_data_of_another_model_and_words_that_are_no_hand_are_refused(self):
        import mujoco

        model, data = squeezed()
        skin = blindgrasp.skin(model, GRIPPER)
        other = mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>"))
        with self.assertRaisesRegex(ValueError, "another model than the skin: expected a new skin"):
            skin.read(other)
        with self.assertRaisesRegex(blindgrasp.ProgramError, "--help"):
            blindgrasp.skin(model, "--help")
        # MuJoCo compiles each built-in hand.
        for urdf in (REPOSITORY / "hands").glob("*.urdf"):
            spec = mujoco.MjSpec.from_file(str(urdf))
            spec.compiler.fusestatic = False
            self.assertGreater(spec.compile().nbody, 2)

    def test_the_example_closes_a_gripper_on_a_ball(self):
        command = [sys.executable, REPOSITORY / "examples/mujoco_skin.py"]
        environment = os.environ | {"PYTHONPATH": str(Path(blindgrasp.__file__).parents[1])}
        printed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        self.assertRegex(printed, r"left: 5\.00 N\n(.*\n){4}right: 5\.00 N\n")


if __name__ == "__main__":
    unittest.main()
