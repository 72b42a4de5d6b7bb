"""MuJoCo for one attempt after another: commands as JSON lines on stdin, one answer a line on stdout.

    {"begin": {"xml", "mesh": {"points_m", "triangles", "geom"} or null, "n_axles", "step_secs"}}
    {"step": {"controls", "most", "velocity", "jumps", "secs"}}   controls and most are null where they stay as they are
    {"touches": {}}

The model has a free palm on three slides, the hand's bodies on it, a target and a stand. Its world has the axes of the
palm, which never turns. Answers to begin and step: the travels of the axles, the target's place and its velocity against the
palm. Answers to touches: [[shape, other, point, normal out of other, newtons], ...]; shapes of the hand have their
number, the target is -1, the stand and the ground are -2.
"""

import sys

# This module is built in. `python3 -c` looks for others in the current folder first, where a stranger's hashlib.py may be,
# and Python has -P since 3.11 only.
sys.path = [place for place in sys.path if place]

import hashlib  # noqa: E402
import json  # noqa: E402
import math  # noqa: E402
import os  # noqa: E402
import pathlib  # noqa: E402

answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # Libraries that print must not print answers.


def answer(value):
    answers.write(json.dumps(value) + "\n")
    answers.flush()


try:
    import mujoco
    import numpy as np
except ImportError as error:
    answer({"error": f"{sys.executable} cannot import mujoco ({error}): expected pip install 'blindgrasp[mujoco]'"})
    sys.exit(0)

# A palm of this mass goes on as it is told, whatever the hand holds.
PALM_KG = 3000.0


def convex_parts(points, triangles):
    """The convex parts of a mesh, by CoACD. They are kept in the user's cache, because they take seconds."""
    points, triangles = np.asarray(points, dtype=float), np.asarray(triangles, dtype=np.int32)
    digest = hashlib.sha256(points.tobytes() + triangles.tobytes()).hexdigest()[:32]
    cache = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache")
    kept = cache / "blindgrasp" / "convex-parts-1" / f"{digest}.npz"
    try:
        with np.load(kept) as parts:
            return [parts[name] for name in parts.files]
    except (OSError, ValueError):
        pass
    try:
        import coacd
    except ImportError as error:
        raise RuntimeError(f"coacd is missing ({error}): expected pip install 'blindgrasp[mujoco]'") from error
    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(points, triangles),
        threshold=0.08,
        max_convex_hull=32,
        resolution=200,
        mcts_nodes=6,
        mcts_iterations=6,
        mcts_max_depth=1,
        max_ch_vertex=48,
        seed=1,
    )
    parts = [np.asarray(vertices, dtype=float) for vertices, _ in found]
    try:
        kept.parent.mkdir(parents=True, exist_ok=True)
        part = kept.with_suffix(f".{os.getpid()}.npz")
        np.savez(part, *parts)
        part.replace(kept)
    except OSError:
        pass
    return parts


class Attempt:
    def __init__(self, xml, mesh, n_axles, step_secs):
        spec = mujoco.MjSpec.from_string(xml)
        if mesh is not None:
            target = spec.body("target")
            for idx, part in enumerate(convex_parts(mesh["points_m"], mesh["triangles"])):
                spec.add_mesh(name=f"part{idx}", uservert=part.flatten())
                target.add_geom(
                    name=f"target{idx}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"part{idx}", **mesh["geom"]
                )
        self.model = spec.compile()
        self.most_secs = step_secs
        self.data = mujoco.MjData(self.model)
        self.n_axles = n_axles
        self.velocity = np.zeros(3)
        self.target = self.model.body("target").id
        names = [self.model.geom(idx).name for idx in range(self.model.ngeom)]
        self.sides = np.array(
            [int(name[5:]) if name.startswith("shape") else -1 if name.startswith(("target", "foot")) else -2 for name in names]
        )
        mujoco.mj_forward(self.model, self.data)

    def state(self):
        data = self.data
        # The slides of the palm come first, then the axles, then the free target.
        palm, target = data.qpos[:3], data.qpos[3 + self.n_axles :]
        centre_velocity = data.cvel[self.target][3:] + np.cross(
            data.cvel[self.target][:3], data.xipos[self.target] - data.subtree_com[self.model.body_rootid[self.target]]
        )
        return {
            "travels": data.qpos[3 : 3 + self.n_axles].tolist(),
            "place": (target[:3] - palm).tolist() + target[3:7].tolist(),
            "velocity": (centre_velocity - data.qvel[:3]).tolist(),
        }

    def step(self, controls, most, velocity, jumps, secs):
        model, data = self.model, self.data
        if controls is not None:
            data.ctrl[:] = controls
            model.actuator_forcerange[:, 1] = most
            model.actuator_forcerange[:, 0] = -model.actuator_forcerange[:, 1]
        wanted = np.asarray(velocity)
        if jumps:
            self.velocity = wanted
        # Whole steps that fill the time, none of them longer than asked for.
        n_steps = math.ceil(secs / self.most_secs - 1e-9)
        model.opt.timestep = secs / n_steps
        change = (wanted - self.velocity) / n_steps
        for _ in range(n_steps):
            data.qvel[:3] = self.velocity
            data.qfrc_applied[:3] = change * (PALM_KG / model.opt.timestep)
            self.velocity = self.velocity + change
            mujoco.mj_step(model, data)
        if not np.isfinite(data.qpos).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            return {"diverged": True}
        return self.state()

    def touches(self):
        contact, data = self.data.contact, self.data
        used = np.flatnonzero(contact.efc_address >= 0)
        found = []
        sides = self.sides[contact.geom[used]].reshape(-1, 2)
        # With elliptic cones the first number of a contact is its force at right angles.
        newtons = data.efc_force[contact.efc_address[used]]
        places, normals, distances = contact.pos[used] - data.qpos[:3], contact.frame[used][:, :3], contact.dist[used]
        for (first, second), force, place, normal, far in zip(sides.tolist(), newtons, places, normals, distances):
            if force <= 0.0:
                continue
            # The normal goes from the first to the second.
            for own, other, sign in ((first, second, 1.0), (second, first, -1.0)):
                if own >= 0 or (own == -1 and other == -2):
                    point = place + sign * normal * (far / 2)
                    found.append([own, other, point.tolist(), (-sign * normal).tolist(), float(force)])
        return found


def main():
    attempt = None
    for line in sys.stdin:
        (command, values), = json.loads(line).items()
        try:
            if command == "begin":
                attempt = Attempt(**values)
                answer(attempt.state())
            elif command == "step":
                answer(attempt.step(**values))
            else:
                answer(attempt.touches())
        except Exception as error:  # The other side says what failed.
            answer({"error": f"{type(error).__name__}: {error}"})


main()
