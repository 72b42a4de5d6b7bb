"""The tactile cells of a hand in a MuJoCo model of the user's own, read from its contacts.

Contacts are spread over cells as `blindgrasp simulate --physics mujoco` does with `sensor.skin`
(lab/crates/simulator/src/skin.rs); a test compares the two. Not here: the rubber's patches, which need the object's
shape, crosstalk, offsets, counts, and cells that are dead or stuck.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from os import PathLike, fspath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ._tables import cells_of

if TYPE_CHECKING:
    import mujoco

# These two are those of skin.rs. Cells feel forces up to so far above or below them, metres.
CELL_DEPTH_M = 0.006
# A skin that keeps force gives cells at most so many times the part of the bell that lies on them.
MOST_GAIN = 3.0
# The standard deviation of a logistic bell is so many times the scale of its hyperbolic tangent.
SIGMA_PER_SCALE = np.pi / (2.0 * np.sqrt(3.0))


@dataclasses.dataclass(frozen=True, kw_only=True)
class SkinOptions:
    """How cells differ from the forces on them. By default they do not."""

    bell_m: float = 0.002
    """The standard deviation at 1 N of the bell over which a contact spreads, metres. It grows with the fourth root of
    the force."""
    kept: float = 1.0
    """The share of the force between and beyond cells that the cells around feel all the same."""
    gain_sigma: float = 0.0
    """The standard deviation of the logarithm of each cell's gain."""
    common_gain_sigma: float = 0.0
    """The same of the gain that all cells share."""
    lag_secs: float = 0.0
    """The time constant with which cells follow a force."""
    creep: float = 0.0
    """Under a constant force the reading grows by this share, and loses it after the force has gone."""
    creep_secs: float = 5.0
    """The time constant of that."""
    noise_newtons: float = 0.0
    """The standard deviation of the noise of each reading."""
    threshold_newtons: float = 0.0
    """Weaker readings are 0."""
    glitch_share: float = 0.0
    """The share of the readings with a spike, which adds the absolute value of a normal number."""
    glitch_newtons: float = 0.4
    """That number's standard deviation."""

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{name} is {value}, expected 0 or more")
            if name in ("bell_m", "creep_secs") and value == 0.0:
                raise ValueError(f"{name} is 0, expected more")
            if name in ("kept", "glitch_share") and value > 1.0:
                raise ValueError(f"{name} is {value}, expected a share from 0 to 1")


def skin(
    model: mujoco.MjModel,
    hand: str | PathLike[str],
    links: Mapping[str, str] | None = None,
    prefix: str = "",
    seed: int = 0,
    **options: float,
) -> Skin:
    """The cells of a hand in a MuJoCo model: `skin(model, hand).read(data)` after each step.

    Args:
        model: the model, which has the hand's links as bodies.
        hand: the name of a built-in hand, or the path of a pad layout (YAML).
        links: for links with another name in the model, the body, or the site, that has the link's frame.
        prefix: stands before the names of the other links, as `MjSpec.attach` puts it there.
        seed: gains, noise and spikes are drawn from it.
        options: the fields of `SkinOptions`.

    Raises:
        ProgramError: the program refuses the hand.
        ValueError: bodies of the model may sleep (`mjENBL_SLEEP`), so that they have no contacts; the model lacks a link of the cells, or its frame lies elsewhere, or an option cannot be. `read` raises it, too: for data of a model that may sleep by now, or of another one, as after `spec.recompile`.
    """
    return Skin(_Places(model, cells_of(fspath(hand)), links or {}, prefix), SkinOptions(**options), seed)


class Skin:
    """The cells of a hand in a MuJoCo model. `blindgrasp.skin` makes it."""

    def __init__(self, places: _Places, options: SkinOptions, seed: int) -> None:
        self._places, self._options = places, options
        self._rng = np.random.default_rng(seed)
        n_cells = len(places.names)
        common = options.common_gain_sigma * self._rng.standard_normal()
        self._gains = np.exp(options.gain_sigma * self._rng.standard_normal(n_cells) + common)
        self._secs = np.inf
        # The forces that cells feel which lag behind them, and their slow part.
        self._felt = self._slow = np.zeros(n_cells)
        self.names = places.names
        """The pad and number of each cell, like `palm_0`, in the hand's order."""

    def reset(self) -> None:
        """Begins at rest: call it after `mj_resetData`. A time before that of the last reading does the same."""
        self._secs = np.inf

    def read(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """The readings of the cells after `mj_step` or `mj_forward`, in the hand's order, newtons."""
        options, rng = self._options, self._rng
        cells = self.forces(data)
        secs, self._secs = data.time - self._secs, data.time
        # The first reading, or one after a reset, begins at rest.
        if secs < 0.0:
            secs, self._felt, self._slow = 0.0, np.zeros_like(cells), np.zeros_like(cells)
        if options.lag_secs:
            self._felt = cells = self._felt + -np.expm1(-secs / options.lag_secs) * (cells - self._felt)
        if options.creep:
            self._slow = self._slow + -np.expm1(-secs / options.creep_secs) * (cells - self._slow)
            cells = cells + options.creep * self._slow
        cells = cells * self._gains
        if options.noise_newtons:
            cells = np.maximum(cells + options.noise_newtons * rng.standard_normal(len(cells)), 0.0)
        if options.threshold_newtons:
            cells[cells < options.threshold_newtons] = 0.0
        if options.glitch_share:
            spikes = np.abs(options.glitch_newtons * rng.standard_normal(len(cells)))
            cells += np.where(rng.random(len(cells)) < options.glitch_share, spikes, 0.0)
        return cells

    def forces(self, data: mujoco.MjData) -> NDArray[np.float64]:
        """The forces on the cells, newtons: what `read` gives without any of the options but the bell's."""
        places, n_cells = self._places, len(self.names)
        places.check(data.model)
        contact = data.contact
        parts = places.part_of_geom.take(contact.geom, mode="wrap")
        if parts.max(initial=-1) < 0:
            return np.zeros(n_cells)
        # The solver leaves some contacts out. The rows of the others follow each other, up to the last row.
        first = contact.efc_address
        used = (first >= 0).nonzero()[0]
        newtons = places.newtons(first.take(used), data.efc_force)
        parts = parts.take(used, 0)
        at, side = ((parts >= 0) & (newtons > 0.0)[:, None]).nonzero()
        if not len(at):
            return np.zeros(n_cells)
        part, newtons, pressed = parts[at, side], newtons.take(at), used.take(at)
        body = places.bodies.take(part)
        # (n_pressed, 2, 3): the point on the other body's surface and the normal out of the side's own body. MuJoCo's
        # normal goes from the first body to the second one, its place is in the middle between the surfaces.
        in_world = np.empty((len(part), 2, 3))
        normal = np.multiply(contact.frame[:, :3].take(pressed, 0), places.signs.take(side, 0), in_world[:, 1])
        point = contact.pos.take(pressed, 0) + normal * (0.5 * contact.dist.take(pressed))[:, None]
        np.subtract(point, data.xpos.take(body, 0), in_world[:, 0])
        in_part = in_world @ data.xmat.take(body, 0).reshape(-1, 3, 3)
        # (n_pressed, 5, n_cells of a part): the ends of each cell along its length and its width, and its normal.
        on_axes = (in_part @ places.axes.take(part, 0)).reshape(len(part), 2, 5, -1)
        beside, facing = on_axes[:, 0] - places.offsets.take(part, 0), on_axes[:, 1, 4]
        per_scale = SIGMA_PER_SCALE / self._options.bell_m * newtons**-0.25
        ends = np.tanh(beside[:, :4] * per_scale[:, None, None])
        # Four times the part of the bell on each cell.
        within = ends[:, ::2] - ends[:, 1::2]
        share = within[:, 0] * within[:, 1] * ((facing > 0.0) & (np.abs(beside[:, 4]) <= CELL_DEPTH_M))
        kept = self._options.kept
        gain = 0.25 * (1.0 - kept) + kept / np.maximum(share.sum(1), 4.0 / MOST_GAIN)
        felt = share * facing * (newtons * gain)[:, None]
        return np.bincount(places.cells.take(part, 0).ravel(), felt.ravel(), n_cells + 1)[:n_cells]


class _Places:
    """Where the cells are: those of each part of the model, of bodies that do not move against each other."""

    def __init__(
        self, model: mujoco.MjModel, cells: list[dict[str, Any]], links: Mapping[str, str], prefix: str
    ) -> None:
        import mujoco

        self.names = [f"{cell['pad']}_{cell['cell']}" for cell in cells]
        with_cells = dict.fromkeys(cell["link"] for cell in cells)
        for link in links:
            if link not in with_cells:
                raise ValueError(f"links names '{link}', which has no cells: expected any of {_quoted(with_cells)}")
        # Bodies with a joint above them have the number of the body that it moves, the others that of their tree.
        numbers = np.where(model.body_weldid > 0, model.body_weldid, model.nbody + model.body_rootid)
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        parts: dict[int, list[tuple[int, NDArray[np.float64]]]] = {}
        for link in with_cells:
            body, place, turn = _frame(model, data, links.get(link, prefix + link), link)
            number = int(numbers[body])
            root = number % model.nbody
            of_root = data.xmat[root].reshape(3, 3)
            rows = [(idx, cell) for idx, cell in enumerate(cells) if cell["link"] == link]
            in_world = [place + turn @ np.array(cell["position_in_link_m"]) for _, cell in rows]
            _check_place(model, data, np.flatnonzero(numbers[model.geom_bodyid] == number), np.array(in_world), link)
            for (idx, cell), middle in zip(rows, in_world):
                along, normal = np.array(cell["along_in_link"]), np.array(cell["normal_in_link"])
                across, (length_m, width_m) = np.cross(normal, along), cell["size_m"]
                axes = of_root.T @ turn @ np.stack([along, along, across, across, normal], axis=1)
                ends_m = 0.5 * np.array([-length_m, length_m, -width_m, width_m, 0.0])
                offsets = (of_root.T @ (middle - data.xpos[root])) @ axes + ends_m
                parts.setdefault(number, []).append((idx, np.vstack([axes, offsets])))
        # Parts with fewer cells are filled with cells without a size, whose force goes nowhere.
        n_parts, most = len(parts), max(map(len, parts.values()), default=0)
        axes, self.offsets = np.zeros((n_parts, 3, 5, most)), np.zeros((n_parts, 5, most))
        self.cells = np.full((n_parts, most), len(cells))
        for part, of_part in enumerate(parts.values()):
            for column, (idx, of_cell) in enumerate(of_part):
                self.cells[part, column] = idx
                axes[part, :, :, column], self.offsets[part, :, column] = of_cell[:3], of_cell[3]
        self.axes = axes.reshape(n_parts, 3, -1)
        self.bodies = np.array(list(parts), dtype=int) % model.nbody
        part_of_number = np.full(2 * model.nbody, -1)
        part_of_number[list(parts)] = np.arange(len(parts))
        # The last one is for -1, the geom of a contact with a flexible body.
        self.part_of_geom = np.append(part_of_number[numbers[model.geom_bodyid]], -1)
        self.signs = np.array([[1.0], [-1.0]])
        self._model, self._elliptic = model, int(mujoco.mjtCone.mjCONE_ELLIPTIC)
        self._sleep = int(getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0))
        self._size = (model.nbody, model.ngeom)
        self.check(model)

    def check(self, model: mujoco.MjModel) -> None:
        """Refuses data whose model would silently read as zeros."""
        if model.opt.enableflags & self._sleep:
            raise ValueError("bodies of the model may sleep, and have no contacts then: expected it without mjENBL_SLEEP")
        if (model.nbody, model.ngeom) != self._size:
            raise ValueError("the data is of another model than the skin: expected a new skin for each compiled model")

    def newtons(self, first: NDArray[np.int32], efc_force: NDArray[np.float64]) -> NDArray[np.float64]:
        """The force at right angles to the surfaces of the contacts with these first rows."""
        if self._model.opt.cone == self._elliptic:
            return efc_force.take(first)
        # It is the sum over the edges of a pyramid.
        return np.add.reduceat(efc_force, first)


def _quoted(names: Any) -> str:
    return ", ".join(f"'{name}'" for name in names)


def _frame(model: mujoco.MjModel, data: mujoco.MjData, name: str, link: str) -> tuple[int, Any, Any]:
    """The body of this name, or the body of the site, and the place and rotation of its frame in the world."""
    bodies = {model.body(idx).name: idx for idx in range(model.nbody)}
    sites = {model.site(idx).name: idx for idx in range(model.nsite)}
    if name in bodies:
        idx = bodies[name]
        return idx, data.xpos[idx], data.xmat[idx].reshape(3, 3)
    if name in sites:
        idx = sites[name]
        return int(model.site_bodyid[idx]), data.site_xpos[idx], data.site_xmat[idx].reshape(3, 3)
    raise ValueError(
        f"the model has no body and no site '{name}' for link '{link}' of the hand: expected "
        f"links={{'{link}': 'NAME'}} with a name of {_quoted(filter(None, [*bodies, *sites]))}"
    )


def _check_place(model: mujoco.MjModel, data: mujoco.MjData, geoms: Any, in_world: Any, link: str) -> None:
    """Refuses a link with cells that lie where no contact of the shapes of its body reaches them."""
    beside_m = np.full(len(in_world), np.inf)
    for geom in geoms:
        in_geom = (in_world - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
        centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        outside_m = np.linalg.norm(np.maximum(np.abs(in_geom - centre) - half, 0.0), axis=1)
        beside_m = np.minimum(beside_m, outside_m)
    if beside_m.max() > CELL_DEPTH_M:
        raise ValueError(
            f"a cell of link '{link}' lies {beside_m.max() * 1e3:.0f} mm beside all shapes of its body, expected at most "
            f"{CELL_DEPTH_M * 1e3:.0f} mm: if the body's frame is not the link's, name in links a site that has it"
        )
