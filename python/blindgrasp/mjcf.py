"""URDF of a hand that is described as a MuJoCo model (MJCF): ``python3 -P -m blindgrasp.mjcf hand.xml hand.urdf``.

It needs the package ``mujoco`` (``pip install 'blindgrasp[mujoco]'``), which reads the file. ``blindgrasp new hand`` then
makes a hand of the URDF.

Bodies become links, hinges and slides become joints, shapes that can touch others become collision shapes; meshes are
written beside the URDF. Joints that an equality constraint or a tendon couples to another one mimic it. A URDF has no
loops: joints that only such a constraint (``connect``, ``weld``) moves are told and stay where they are.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

__all__ = ["urdf_of"]


def urdf_of(model_path: str | os.PathLike[str], urdf_path: str | os.PathLike[str]) -> list[str]:
    """Writes the URDF of a model, and its collision meshes to the folder ``meshes`` beside it.

    Args:
        model_path: the MJCF file (``<mujoco>``), or any other that the package ``mujoco`` reads.
        urdf_path: where to write the URDF.

    Returns:
        The parts of the model that a URDF cannot hold, a line for each.

    Raises:
        ImportError: the package ``mujoco`` is missing.
        ValueError: ``mujoco`` refuses the model.
    """
    try:
        import mujoco
    except ImportError as error:
        raise ImportError("the package mujoco is missing: pip install 'blindgrasp[mujoco]'") from error
    try:
        model = mujoco.MjModel.from_xml_path(str(model_path))
    except ValueError as error:
        if "Unrecognized XML model type" in str(error):
            raise ValueError(f"{error}: expected a whole model (<mujoco>); of a part, convert the file that includes it") from error
        raise
    return _Conversion(mujoco, model, Path(urdf_path)).write()


class _Conversion:
    def __init__(self, mujoco, model, urdf_path: Path):
        self.mujoco, self.model, self.urdf_path = mujoco, model, urdf_path
        self.robot = ElementTree.Element("robot", name=urdf_path.stem)
        self.told: list[str] = []
        self.mimics = self._mimics()
        # The link of each body, and its origin in the body's frame: the place of the body's last joint.
        self.links: dict[int, str] = {}
        self.origins: dict[int, np.ndarray] = {}
        self.meshes: dict[int, str] = {}

    def name(self, kind: str, idx: int) -> str:
        obj = getattr(self.mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        return self.mujoco.mj_id2name(self.model, obj, idx) or f"{kind}_{idx}"

    def write(self) -> list[str]:
        for body in range(self.model.nbody):
            self._add_body(body)
        self._tell_loops()
        if self.robot.find("link/collision") is None:
            self.told.append(
                f"none of the {self.model.ngeom} shapes can touch others (contype and conaffinity are 0): the links have no "
                "collision shapes, so give those that touch an object contype 1"
            )
        model, hinge = self.model, int(self.mujoco.mjtJoint.mjJNT_HINGE)
        hinges = [joint for joint in range(model.njnt) if int(model.jnt_type[joint]) == hinge and model.jnt_limited[joint]]
        widest = max((np.abs(model.jnt_range[joint]).max() for joint in hinges), default=np.inf)
        # A full turn in radians, read as degrees.
        if np.rad2deg(widest) <= 2 * np.pi:
            self.told.append(
                f"no joint turns by more than {np.rad2deg(widest):.2g} degrees: if the ranges are radians, write <compiler "
                'angle="radian"/> into the file, which a fragment leaves to the file that includes it'
            )
        self.urdf_path.parent.mkdir(parents=True, exist_ok=True)
        ElementTree.indent(self.robot)
        ElementTree.ElementTree(self.robot).write(self.urdf_path, encoding="utf-8", xml_declaration=True)
        return self.told

    def _add_body(self, body: int) -> None:
        model = self.model
        name, origin = self.name("body", body), np.zeros(3)
        if body == 0:
            self._add_link(name)
        else:
            parent = int(model.body_parentid[body])
            above, xyz = self.links[parent], model.body_pos[body] - self.origins[parent]
            rotation = _matrix(model.body_quat[body])
            joints = [model.body_jntadr[body] + nth for nth in range(model.body_jntnum[body])]
            moving = [joint for joint in joints if self._moves(joint)]
            for nth, joint in enumerate(moving):
                link = name if nth == len(moving) - 1 else self._free_name(f"{name}_{nth + 1}")
                anchor = np.array(model.jnt_pos[joint])
                self._add_link(link)
                self._add_joint(joint, above, link, xyz + rotation @ (anchor - origin), rotation)
                # The next joint of the body is in the frame of this one.
                above, xyz, rotation, origin = link, np.zeros(3), np.eye(3), anchor
            if not moving:
                self._add_link(name)
                self._fix(f"{name}_fixed", above, name, xyz, rotation)
        self.links[body], self.origins[body] = name, origin
        for geom in range(model.ngeom):
            if model.geom_bodyid[geom] == body and (model.geom_contype[geom] or model.geom_conaffinity[geom]):
                self._add_shape(geom, name, origin)

    def _moves(self, joint: int) -> bool:
        kind = int(self.model.jnt_type[joint])
        if kind == int(self.mujoco.mjtJoint.mjJNT_BALL):
            self.told.append(f"joint '{self.name('joint', joint)}' is a ball: it counts as fixed")
        kinds = self.mujoco.mjtJoint
        return kind in (int(kinds.mjJNT_HINGE), int(kinds.mjJNT_SLIDE))

    def _free_name(self, name: str) -> str:
        taken = {self.name("body", body) for body in range(self.model.nbody)}
        while name in taken:
            name += "_"
        return name

    def _add_link(self, name: str) -> None:
        ElementTree.SubElement(self.robot, "link", name=name)

    def _joint(self, name: str, kind: str, parent: str, child: str, xyz, rotation):
        joint = ElementTree.SubElement(self.robot, "joint", name=name, type=kind)
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=child)
        ElementTree.SubElement(joint, "origin", xyz=_text(xyz), rpy=_text(_rpy(rotation)))
        return joint

    def _fix(self, name: str, parent: str, child: str, xyz, rotation) -> None:
        self._joint(name, "fixed", parent, child, xyz, rotation)

    def _add_joint(self, joint: int, parent: str, child: str, xyz, rotation) -> None:
        model = self.model
        is_hinge = int(model.jnt_type[joint]) == int(self.mujoco.mjtJoint.mjJNT_HINGE)
        is_limited = bool(model.jnt_limited[joint])
        kind = ("revolute" if is_limited else "continuous") if is_hinge else "prismatic"
        element = self._joint(self.name("joint", joint), kind, parent, child, xyz, rotation)
        ElementTree.SubElement(element, "axis", xyz=_text(model.jnt_axis[joint]))
        lower, upper = model.jnt_range[joint] if is_limited else (-1.0, 1.0)
        # MuJoCo's value of the pose of the file is `ref`, a URDF's is 0.
        ref = model.qpos0[model.jnt_qposadr[joint]]
        if is_limited or not is_hinge:
            ElementTree.SubElement(
                element, "limit", lower=_text([lower - ref]), upper=_text([upper - ref]), effort="0", velocity="0"
            )
        if joint in self.mimics:
            other, multiplier, offset = self.mimics[joint]
            ElementTree.SubElement(
                element, "mimic", joint=self.name("joint", other), multiplier=_text([multiplier]), offset=_text([offset])
            )

    def _mimics(self) -> dict[int, tuple[int, float, float]]:
        """Of a coupled joint the one that it follows, multiplier and offset."""
        model, mujoco = self.model, self.mujoco
        mimics: dict[int, tuple[int, float, float]] = {}
        driven = {
            int(model.actuator_trnid[idx][0])
            for idx in range(model.nu)
            if int(model.actuator_trntype[idx]) == int(mujoco.mjtTrn.mjTRN_JOINT)
        }
        for idx in range(model.neq):
            if int(model.eq_type[idx]) != int(mujoco.mjtEq.mjEQ_JOINT) or int(model.eq_obj2id[idx]) < 0:
                continue
            first, second = int(model.eq_obj1id[idx]), int(model.eq_obj2id[idx])
            offset, multiplier, *higher = (float(number) for number in model.eq_data[idx][:5])
            if first in driven and second not in driven and multiplier != 0.0:
                # y = a + b x, so x = (y - a) / b.
                first, second, offset, multiplier = second, first, -offset / multiplier, 1.0 / multiplier
            if any(abs(number) > 1e-9 for number in higher):
                self.told.append(
                    f"joint '{self.name('joint', first)}' follows '{self.name('joint', second)}' by a polynomial: only its "
                    "linear part is kept"
                )
            mimics[first] = (second, multiplier, offset)
        for idx in range(model.nu):
            if int(model.actuator_trntype[idx]) != int(mujoco.mjtTrn.mjTRN_TENDON):
                continue
            tendon = int(model.actuator_trnid[idx][0])
            begin, n = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
            wraps = range(begin, begin + n)
            is_fixed = all(int(model.wrap_type[wrap]) == int(mujoco.mjtWrap.mjWRAP_JOINT) for wrap in wraps)
            pulled = [(int(model.wrap_objid[wrap]), float(model.wrap_prm[wrap])) for wrap in wraps] if is_fixed else []
            # One motor pulls them all, as a finger's last two joints or a gripper's jaws: they move alike.
            for joint, arm in pulled[1:]:
                first, first_arm = pulled[0]
                if joint in driven or joint in mimics or first in mimics or not arm * first_arm:
                    continue
                mimics[joint] = (first, 1.0 if arm * first_arm > 0 else -1.0, 0.0)
                if abs(abs(arm) - abs(first_arm)) > 1e-9:
                    self.told.append(
                        f"joints '{self.name('joint', first)}' and '{self.name('joint', joint)}' share a tendon with other "
                        "arms: the URDF lets them move alike"
                    )
        return mimics

    def _tell_loops(self) -> None:
        model, mujoco = self.model, self.mujoco
        kinds = {int(mujoco.mjtEq.mjEQ_CONNECT): "connect", int(mujoco.mjtEq.mjEQ_WELD): "weld"}
        for idx in range(model.neq):
            kind = kinds.get(int(model.eq_type[idx]))
            if kind:
                bodies = [int(model.eq_obj1id[idx]), int(model.eq_obj2id[idx])]
                if int(model.eq_objtype[idx]) == int(mujoco.mjtObj.mjOBJ_SITE):
                    bodies = [int(model.site_bodyid[site]) for site in bodies]
                ends = [self.name("body", body) for body in bodies]
                self.told.append(
                    f"the bodies '{ends[0]}' and '{ends[1]}' make a loop ({kind}), which a URDF cannot have: let the joints "
                    "between them mimic the driven one by hand"
                )

    def _add_shape(self, geom: int, link: str, origin: np.ndarray) -> None:
        model, kinds = self.model, self.mujoco.mjtGeom
        kind, size = int(model.geom_type[geom]), model.geom_size[geom]
        ends = {"radius": _text(size[:1])}
        along = ends | {"length": _text(2 * size[1:2])}
        # Each shape, and how far it lies from the middle along z. URDF as ROS reads it has no capsules.
        shapes: dict[int, Any] = {
            int(kinds.mjGEOM_SPHERE): lambda: [("sphere", ends, 0.0)],
            int(kinds.mjGEOM_CAPSULE): lambda: [
                ("cylinder", along, 0.0), ("sphere", ends, size[1]), ("sphere", ends, -size[1])
            ],
            int(kinds.mjGEOM_CYLINDER): lambda: [("cylinder", along, 0.0)],
            int(kinds.mjGEOM_BOX): lambda: [("box", {"size": _text(2 * size)}, 0.0)],
            int(kinds.mjGEOM_ELLIPSOID): lambda: [("mesh", {"filename": self._ellipsoid(geom)}, 0.0)],
            int(kinds.mjGEOM_MESH): lambda: [("mesh", {"filename": self._mesh(geom)}, 0.0)],
        }
        if kind not in shapes:
            # A plane or a terrain is not part of a hand.
            return
        element = next(element for element in self.robot if element.tag == "link" and element.get("name") == link)
        rotation = _matrix(model.geom_quat[geom])
        for name, attributes, aside_m in shapes[kind]():
            collision = ElementTree.SubElement(element, "collision")
            middle = model.geom_pos[geom] - origin + aside_m * rotation[:, 2]
            ElementTree.SubElement(collision, "origin", xyz=_text(middle), rpy=_text(_rpy(rotation)))
            ElementTree.SubElement(ElementTree.SubElement(collision, "geometry"), name, attributes)

    def _mesh(self, geom: int) -> str:
        model, mesh = self.model, int(self.model.geom_dataid[geom])
        if mesh not in self.meshes:
            first, n = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            face, n_faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
            vertices, faces = model.mesh_vert[first : first + n], model.mesh_face[face : face + n_faces]
            self.meshes[mesh] = self._write(f"{self.name('mesh', mesh)}.obj", vertices, faces)
        return self.meshes[mesh]

    def _ellipsoid(self, geom: int) -> str:
        rings = np.linspace(0, np.pi, 13)[:, None]
        around = np.linspace(0, 2 * np.pi, 24, endpoint=False)[None, :]
        unit = np.stack(np.broadcast_arrays(np.sin(rings) * np.cos(around), np.sin(rings) * np.sin(around), np.cos(rings)), -1)
        vertices = unit.reshape(-1, 3) * self.model.geom_size[geom]
        quads = [
            (24 * row + column, 24 * (row + 1) + column, 24 * (row + 1) + (column + 1) % 24, 24 * row + (column + 1) % 24)
            for row in range(12)
            for column in range(24)
        ]
        faces = [corner for a, b, c, d in quads for corner in ((a, b, c), (a, c, d))]
        return self._write(f"{self.name('geom', geom)}.obj", vertices, faces)

    def _write(self, name: str, vertices, faces) -> str:
        folder = self.urdf_path.parent / "meshes"
        folder.mkdir(parents=True, exist_ok=True)
        file = "".join(char if char.isalnum() or char in "._-" else "_" for char in name)
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices]
        lines += [f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in faces]
        (folder / file).write_text("".join(lines))
        return f"meshes/{file}"


def _matrix(wxyz) -> np.ndarray:
    w, x, y, z = np.asarray(wxyz) / np.linalg.norm(wxyz)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _rpy(matrix: np.ndarray) -> list[float]:
    """Roll, pitch and yaw of a rotation, as a URDF takes them."""
    pitch = float(np.arctan2(-matrix[2, 0], np.hypot(matrix[0, 0], matrix[1, 0])))
    if abs(abs(pitch) - np.pi / 2) < 1e-6:
        return [float(np.arctan2(-matrix[1, 2], matrix[1, 1])), pitch, 0.0]
    return [
        float(np.arctan2(matrix[2, 1], matrix[2, 2])),
        pitch,
        float(np.arctan2(matrix[1, 0], matrix[0, 0])),
    ]


def _text(numbers) -> str:
    return " ".join(f"{float(number):.9g}" for number in numbers)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python3 -P -m blindgrasp.mjcf", description="URDF of a hand from a MuJoCo model (MJCF)")
    parser.add_argument("model", type=Path, help="the model (XML)")
    parser.add_argument("urdf", type=Path, help="where to write the URDF; meshes go to the folder meshes beside it")
    arguments = parser.parse_args()
    try:
        told = urdf_of(arguments.model, arguments.urdf)
    except (ImportError, ValueError) as error:
        print(f"{arguments.model}: {error}", file=sys.stderr)
        return 1
    for line in told:
        print(line, file=sys.stderr)
    print(f"{arguments.urdf}: now blindgrasp new hand NAME --urdf {arguments.urdf}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
