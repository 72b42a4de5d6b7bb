#!/usr/bin/env python3
"""The cells of a gripper in a MuJoCo scene of your own: it closes on a ball, and prints each pad's cells in newtons.

    python3 examples/mujoco_skin.py          needs pip install 'blindgrasp[mujoco]', and the program blindgrasp

Visual Studio Code, Spyder and Jupyter (with jupytext) open it cell by cell, as a notebook.
"""

# %% The gripper, which MuJoCo reads from its URDF, with motors and a ball between its jaws.
from pathlib import Path

import blindgrasp
import mujoco

hands = Path(globals().get("__file__", "mujoco_skin.py")).resolve().parent.parent / "hands"
spec = mujoco.MjSpec.from_file(str(hands / "parallel-gripper.urdf"))
# Links without a joint stay bodies, which cells can lie on.
spec.compiler.fusestatic = False
spec.option.gravity = [0.0, 0.0, 0.0]
for joint in spec.joints:
    motor = spec.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.gainprm[0] = 1.0
ball = spec.worldbody.add_body(name="ball", pos=[0.002, 0.0, 0.043])
ball.add_freejoint()
ball.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.02, 0.0, 0.0], mass=0.05, condim=4)
model = spec.compile()
model.dof_damping[:2] = 20.0
data = mujoco.MjData(model)

# %% The skin, and a second in which the jaws close with 5 N.
skin = blindgrasp.skin(model, hands / "parallel-gripper.yaml")
data.qpos[:2] = 0.04
data.ctrl[:] = -5.0
while data.time < 1.0:
    mujoco.mj_step(model, data)
    cells = skin.read(data)

# %% The cells of each pad.
for pad, newtons in (("left", cells[:12]), ("right", cells[12:])):
    print(f"{pad}: {newtons.sum():.2f} N")
    print(newtons.reshape(4, 3).round(2))
