"""The contact problem of one time step: free motion, contact frames, the map between bodies and contacts.

With v the velocities of all bodies (6 each) and g the impulses of all contacts (normal, t1, t2 each):

    D' v       velocities of body b relative to body a at the contact points, in the contact frames,
    D g        impulses and angular impulses on the bodies: +g on b, -g on a,
    v          = v_free + M^-1 D g,  v_free = v_old + dt M^-1 f,
    G          = D' M^-1/2, the mass-scaled map, so that the Delassus matrix is N = G G' = D' M^-1 D,
    r          = b + D' v_free,  b = (gap / dt, 0, 0) per contact.

Bodies of prescribed motion have M^-1 = 0 and their prescribed velocity as v_free. For a guided body M^-1 is
d d' / m, with d the direction of its guide.
Source: Anitescu and Hart (2004), Tasora and Anitescu (2011): the cone complementarity problem of a time step.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from dem.arrays import Bools, Floats, Keys, places
from dem.bodies import Bodies
from dem.compiled import inlined, loop
from dem.contact_map import CompactRows, ContactMap, Halo
from dem.contact_map.loops import closing, scaled_row
from dem.contact_map.mass import CellMass, ConstrainedMass
from dem.contact_map.rows import UPPER
from dem.free_motion import kept_velocities
from dem.model.world import World
from dem.parts.laws import Solved
from dem.start import stiffness
from dem.step.landing import landing
from dem.step.laws import along_normal, contact_state, slowest
from dem.step.resistance import resistance
from dem.step.servo import cell_of
from dem.step.surface import surface_velocities
from dem.unconstrained import UnconstrainedMotion, free_velocities, large_velocity
from dem.unconstrained.constraints import Coupling, coupling_of, coupling_refound, slots
from dem.unconstrained.drives import Drives, free_directions

if TYPE_CHECKING:
    from dem.contact import Contacts

#: Bodies that contacts turned by more radians in the last step were struck: those impulses do not come again.
STRUCK = 0.05
MADE = 0.01  #: energy that impacts may make, as a part of what their impulses exchange, before they bounce less
MUCH = 0.1  #: the same, before they have no friction, where they cannot bounce less
PARTS = np.array([0.0, 0.25, 0.5, 0.75, 0.9, 1.0])  #: of e, that are tried from the last to the first


class ContactSystem:
    """The contact problem of one step on this rank. The constructor is collective; other members say so.

    Attributes, of nc local contacts and of the bodies whose rows this rank owns (`World.owned`):
        dt (float): step [s]
        motion: without contacts, a `dem.unconstrained.UnconstrainedMotion`, with `push` and coupling of the step
        contacts: as the search found them
        key (nc,), point (nc, 3): contact key, contact point [m]
        friction (nc,), mu (nc,): friction coefficient, and that of the cones: zero in impacts that are `smooth`
        frame (nc, 3, 3): rows normal (from a to b), t1, t2
        stiffness (nc,): of the contacts; inf: rigid [N/m]
        compliance (nc, 3): C, the relative velocity that an impulse along the normal, or a tangent, leaves for its
        spring; 0: rigid [1/kg]
        last (nc,), held (nc, 2): the normal impulses of the last step, and what tangential springs hold at the start of
        this one [N s]
        cell: its part in the step, a `dem.contact_map.mass.CellStep`; None where its size is constant
        drift (nc, 3): what the cell adds to relative velocities, in the frames, or None; until `take_flow` that of the
        last step, in a cell that deforms [m/s]
        surface (nc, 2): tangential velocities of surfaces [m/s], see `dem.step.surface`; None if there is none
        r (nc, 3): b + D' v_free, b = (gap / dt, surface), see `gap_velocities` [m/s]; zero where it is rounding, see
        `dem.contact_map.loops.closing`
        near: the bodies about this rank
        contact_map: G, with the halo of the bodies; the rows of its tables are those of `near`
        problem_map: G of the cone problem: with the rows of turning, where contacts resist it
        free_velocity (owned, 6): velocities without contacts, but with their attraction
        free_large (large, 6): the same of the large bodies, without attraction, on all ranks
        middle (owned, 3): the angular velocities about which those of the step are linear in the impulses, see
        `dem.free_motion.free_spin`, or None
        resistance: the rows of `dem.step.resistance`, or None
        contact_state: the contacts, as the laws of contact see them; None where none adds anything
        past (nc, columns): what the laws of contact kept of them in the last step
        attraction (nc,): attractive impulses along the normals [N s], or None; see `dem.parts.laws`
        landing: what contacts bear until bodies land, a `dem.step.landing.Landing`, or None
        later (nc, 3): what of it they bear in the next step, which `kept` finds and gives bodies at once [N s]
        drives: of the large bodies, the same on all ranks
        strikes (nc,): which contacts are impacts
        jams: whether the impulses of impacts make much energy, once `eased` has looked
        at_once: how many contacts of this rank bounce with all others of the step, and not in their order
        coupling: by constraints, a `dem.unconstrained.constraints.Coupling`; None if there are none
        applied: what parts give, a `dem.unconstrained.applied.Applied`; None if none do
    """

    def __init__(
        self, world: World, contacts: Contacts, motion: UnconstrainedMotion, recovery_speed: float = np.inf,
        last: Floats | None = None, eased: tuple[Keys, Floats] | None = None, smooth: bool = False,
        kept: Floats | None = None,
    ) -> None:  # fmt: skip
        """`recovery_speed` [m/s] bounds the speed at which overlaps of rigid contacts are pushed apart. `last`: what
        the memory of the last step has of these contacts (parts nc, 3): the impulses that they are expected to have,
        and with which springs begin. `eased`: contacts that bounce with a part of e alone, by key, from the method of
        that name; `smooth`: impacts without friction; `kept` (nc, columns): what the laws of contact kept of these
        contacts."""
        if np.isnan(recovery_speed) or recovery_speed < 0.0:
            raise ValueError(f"recovery speed must not be negative, got {recovery_speed}")
        self.dt, self.contacts, self.near = motion.dt, contacts, contacts.near
        self.drives, self.applied = motion.drives, motion.applied
        self.key, self.point, self.frame = contacts.key, contacts.point, contacts.frame
        last = np.zeros((len(contacts), 3)) if last is None else last[: len(contacts)]
        self.last, self.held = last[:, 0], last[:, 1:]
        self.contact_map = _map_of(world, contacts, self.frame, self.drives)
        self.surface = surface_velocities(world, contacts, self.frame)
        self.take_flow(world, contacts)
        self._meet_laws(world, kept)
        self.motion, change = self._linearised(world, motion, last)
        free, freely, rounding = self._free(world, change)
        b = self._gap_velocities(world, recovery_speed)
        self.resistance = resistance(world, contacts, self.contact_state, self.contact_map, self.frame, free)
        self.problem_map = self.contact_map if self.resistance is None else self.resistance.map
        self.landing = landing(world, contacts, self.contact_map, free, freely, last, self.dt)
        self._bear(freely, b)
        self.strikes = self._impacts(world, freely, eased, b)
        self.mu = np.where(self.strikes, 0.0, self.friction) if smooth else self.friction
        swing = np.zeros((0, 3)) if contacts.swing is None else contacts.swing
        self.r = _beyond(b, freely, rounding, self.frame, swing, self.strikes, self.compliance, self.held)
        if self.resistance is not None:
            self.resistance.velocity[np.abs(self.resistance.velocity) <= rounding[:, None]] = 0.0

    def _meet_laws(self, world: World, kept: Floats | None) -> None:
        """Find what the laws of contact make of the contacts: attraction, and the friction of the cones."""
        contacts, pairs = self.contacts, world.pairs
        self.past = np.zeros((len(contacts), pairs.columns)) if kept is None else kept
        self.contact_state, self.attraction, self.friction = None, None, contacts.friction
        if pairs.acting:
            self.contact_state = state = contact_state(world, contacts, self.dt, self._slip(contacts))
            pull = pairs.attraction(state, self.past)
            self.attraction = None if pull is None else self.dt * pull
            self.friction = pairs.cone(state, self.past, contacts.friction)

    def _gap_velocities(self, world: World, recovery_speed: float) -> Floats:
        """b (nc, 3), and the stiffness and compliance of the contacts."""
        b = np.zeros((len(self.contacts), 3))
        self.stiffness, self.compliance, b[:, 0] = gap_velocities(world, self.contacts, self.dt, recovery_speed)
        if self.surface is not None:
            b[:, 1:] = self.surface
        return b

    def _bear(self, freely: Floats, b: Floats) -> None:
        """Add what contacts do beside the cone problem, by attraction and until bodies land, to the velocities without
        impulses of bodies, of contacts, `freely` (nc, 3), and of turning, and to b (nc, 3); collective."""
        self._given: Floats | float = 0.0  #: mass-scaled momenta of what is no part of the cone problem
        self.later: Floats | None = None
        if self.attraction is None and self.landing is None:
            return
        self._given = self.contact_map.momenta(self.net(np.zeros_like(freely)))
        self.free_velocity = self.velocity_with(self._given)
        change = self.problem_map.velocities(self._given)
        freely += change[: len(freely)]
        if self.resistance is not None:
            self.resistance.velocity[:] += change[len(freely) :]
        if self.landing is not None:
            b += self.landing.before * self.compliance

    def _linearised(
        self, world: World, motion: UnconstrainedMotion, last: Floats
    ) -> tuple[UnconstrainedMotion, Floats | None]:
        """The motion with constraints, and with the push about which it is linear where bodies turn in other ways than
        spheres, if it has none yet: that of the `last` impulses (nc, 3); and what the push changes of the velocities
        (owned, 6). Collective."""
        change, push = None, motion.push
        if push is None and world.turns_unlike_spheres:
            pull = 0.0 if self.attraction is None else along_normal(self.attraction)
            push = self.contact_map.momenta(last - pull)
        if push is not None:
            change = _expected(self.contact_map.source.root, push, self.dt)
        coupling = motion.coupling
        if coupling is None:
            coupling = coupling_of(world, motion.applied, motion.motion_velocities, self.dt, push)
        if push is motion.push and coupling is motion.coupling:
            return motion, change
        return replace(motion, push=push, coupling=coupling), change

    def _free(self, world: World, change: Floats | None) -> tuple[Floats, Floats, Floats]:
        """Velocities (rows, 6) without contacts of the bodies of `near`, with constraints, of contacts (nc, 3), with
        the cell, and their rounding (nc,); collective. Sets `middle`, and the inverse mass of the map."""
        given, row = self.contact_map.source, self.contact_map.body
        free, self.middle = free_velocities(world, self.near, self.motion, change)
        if self.applied is not None or change is not None:
            self.contact_map.halo.update(free)
        if world.pairs.bounces:
            moves = np.isfinite(self.near.bodies.mass)[:, None]
            self._forced = np.where(moves, free[:, :3] - self.near.bodies.velocity[:, :3], 0.0)  # not by constraints
        freely, rounding = closing(given.frame, given.arm, row, free)
        self.coupling = self.motion.coupling
        if self.coupling is not None:
            self._constrain(world, self.coupling, free)
            freely, more = closing(given.frame, given.arm, row, free)
            rounding += more
        self.free_velocity, self.free_large = free[: world.owned], free[self.near.grains + self.near.ghosts :]
        self.cell = cell_of(world, self.dt)
        if self.cell is not None:
            self.contact_map = self.contact_map.with_mass(CellMass(world.comm, given.root, self.cell))
            way = self.contacts.branch(self.near.bodies.position)
            freely += np.einsum("cij,cj->ci", self.frame, self.cell.free * way)
        if self.contacts.drift is not None:
            freely += np.einsum("cij,cj->ci", self.frame, self.contacts.drift)
        return free, freely, rounding

    def _constrain(self, world: World, coupling: Coupling, free: Floats) -> None:
        """Let constraints change the free velocities (rows, 6), and the inverse mass."""
        owned = world.owned
        here, slot = slots(world, self.near.bodies.id)
        spin = coupling.spin[slot]
        free[here, 3:] = np.where(np.isnan(spin), free[here, 3:], spin)
        free[here] += coupling.change[slot]
        own = here < owned
        if self.middle is not None:
            self.middle[here[own]] = coupling.middle[slot[own]]
        mass = ConstrainedMass(world.comm, self.contact_map.source.root, here[own], slot[own], coupling.matrix)
        self.contact_map = self.contact_map.with_mass(mass)

    def _impacts(self, world: World, freely: Floats, eased: tuple[Keys, Floats] | None, b: Floats) -> Bools:
        """Which contacts (nc,) are impacts: they bounce, or `dem.step.impacts` gives them the speed with which they
        part. By b (nc, 3) they part so."""
        self.at_once, self._bounces = 0, np.zeros(len(b), np.bool_)
        if world.pairs.bounces:
            self._freely = freely
            self._bounce(world, freely[:, 0], eased, b)
        parting = self.contacts.parting
        if parting is None:
            return self._bounces
        strikes: Bools = np.isfinite(parting)
        b[strikes, 0], self.compliance[strikes] = -parting[strikes], 0.0
        return self._bounces | strikes

    def _bounce(self, world: World, freely: Floats, eased: tuple[Keys, Floats] | None, b: Floats) -> None:
        """Let contacts that begin within the step leave with e times the normal speed with which they came (Newton),
        see `_parting`, by the normal numbers of b (nc, 3).

        They begin if without impulses they close in the step, `freely` (nc,) [m/s], and come faster than `slowest`: a
        body at rest does not bounce."""
        contacts, table = self.contacts, self.near.bodies
        e = world.pairs.restitution[table.material[contacts.a], table.material[contacts.b]]
        came = self.contact_map.relative_velocities(table.velocity)[:, 0]
        if self.drift is not None:
            came = came + self.drift[:, 0]
        closes = contacts.linear_gap + self.dt * freely < 0.0
        slow = slowest(world, contacts, self.dt, came - freely, self._forced)
        begin = (e > 0.0) & (came < -slow) & closes
        if contacts.parting is not None:
            begin &= np.isnan(contacts.parting)
        self.at_once, self._bounces, self._part = int(begin.sum()), begin, np.ones(len(contacts))
        if eased is not None:
            place = places(eased[0], self.key)
            self._part[place >= 0] = eased[1][place[place >= 0]]
            e = e * self._part
        parts = _parting(e[begin], came[begin], (came - freely)[begin], contacts.linear_gap[begin], self.dt)
        b[begin, 0] = np.minimum(b[begin, 0], -parts)
        self.compliance[begin] = 0.0

    def eased(self, world: World, impulse: Floats, momentum: Floats) -> tuple[Keys, Floats] | None:
        """Contacts that are to bounce less, by key, and with which part of e: the next one for those whose impulses do
        work, where all contacts together, with these impulses (parts nc, 3) and momenta, make energy. Newton's law of
        impacts may do so with friction (Kane and Levinson 1985), and does not at e = 0. None if they make none, or if
        no part is left; `jams` tells whether it is much of what impacts then exchange. Collective."""
        self.jams = False
        if not world.pairs.bounces:
            return None
        parts = 1 if self.resistance is None else 2
        g = impulse.reshape(parts, len(self.key), 3)
        change = self.problem_map.velocities(momentum.reshape(-1, 6)).reshape(g.shape)
        slips = [self._freely if self.surface is None else self._freely + np.pad(self.surface, ((0, 0), (1, 0)))]
        free = np.stack(slips if self.resistance is None else [*slips, self.resistance.velocity])
        work, exchanged = np.einsum("pci,pci->c", g, free + 0.5 * change), 0.5 * np.einsum("pci,pci->c", g, change)
        less = self._bounces & (work > 0.0) & (self._part > 0.0)
        here = work.sum(), exchanged.sum(), less.sum(), work[self.strikes].sum(), exchanged[self.strikes].sum()
        sums = self.contact_map.comm.allreduce(np.array(here))
        if sums[2] == 0.0 or sums[0] <= MADE * sums[1]:
            self.jams = bool(sums[3] > MUCH * sums[4])
            return None
        self._part[less] = PARTS[np.searchsorted(PARTS, self._part[less]) - 1]
        eased = self._part < 1.0
        return self.key[eased], self._part[eased]

    def _slip(self, contacts: Contacts) -> Floats:
        """The relative velocities (nc, 2) along the surfaces before the step [m/s]."""
        slip = self.contact_map.relative_velocities(contacts.near.bodies.velocity)[:, 1:]
        slip = slip if self.surface is None else slip + self.surface
        return slip if self.drift is None else slip + self.drift[:, 1:]

    def held_after(self, impulse: Floats) -> Floats:
        """Impulses of the step (parts nc, 3), see `ContactLaw.parts`, with what tangential springs hold at its end
        in the place of the tangential ones [N s]."""
        return stiffness.held_after(self.stiffness, self.compliance, self.dt, self.held, self._with_borne(impulse))

    def keep(self, world: World, impulse: Floats, momentum: Floats) -> Floats:
        """What the laws of contact keep (nc, columns) for the next step, for the impulses (parts nc, 3) of the cone
        problem and their momenta; collective."""
        if not world.pairs.columns or self.contact_state is None:
            return self.past
        count = len(self.key)
        impulse, change = impulse[:count], self.problem_map.velocities(momentum.reshape(-1, 6))[:count]
        slip = (self.r + change)[:, 1:] + self.compliance[:, 1:] * impulse[:, 1:]
        impulse = self._with_borne(impulse)
        return world.pairs.keep(self.contact_state, self.past, Solved(impulse, self.mu, np.hypot(*slip.T)))

    def net(self, impulse: Floats) -> Floats:
        """What contacts do to bodies (nc, 3) whose impulses in the friction cones (nc, 3) are these [N s]."""
        impulse = self._with_borne(impulse)
        return impulse if self.attraction is None else impulse - along_normal(self.attraction)

    def _with_borne(self, impulse: Floats) -> Floats:
        """Impulses in the friction cones (parts nc, 3) with what contacts bear before bodies land."""
        if self.landing is None:
            return impulse
        impulse = impulse.copy()
        impulse[: len(self.key)] += self.landing.before
        return impulse

    def parts(self, impulse: Floats) -> tuple[Floats, Floats | None]:
        """What contacts do to bodies (nc, 3), and their moments (nc, 3) where they resist rolling, for the impulses
        (parts nc, 3) of the cone problem [N s]."""
        count = len(self.key)
        net = self.net(impulse[:count])
        net = net if self.later is None else net + self.later
        return net, None if self.resistance is None else impulse[count:]

    def velocity(self, impulse: Floats) -> Floats:
        """Velocities (owned, 6) after the step, v_free + M^-1 D g, for impulses (nc, 3); collective."""
        return self.velocity_with(self.contact_map.momenta(impulse))

    def velocity_with(self, momentum: Floats) -> Floats:
        """Velocities (owned, 6) after the step for the mass-scaled momenta G' g (owned, 6), in any shape."""
        change = np.empty(self.free_velocity.shape)
        self.contact_map.mass.scale(momentum.reshape(-1, 6), change)
        return self.free_velocity + change

    def kept(self, velocity: Floats, impulse: Floats) -> Floats | None:
        """The velocities (owned, 6) with which bodies go into the next step, where those of this one are `velocity`,
        and impulses in the friction cones (parts nc, 3): others of bodies that are no spheres, see
        `dem.free_motion.kept_velocities`, and of those that land; None: the same. Collective."""
        kept, table = None, self.near.bodies
        if self.middle is not None:
            kept = kept_velocities(table.quaternion, velocity, self.middle, table.inertia, self.dt)
        if self.landing is None:
            return kept
        self.later = self.landing.rest(impulse[: len(self.key)], self.contact_map.body, len(table.mass))
        momentum, change = self.contact_map.momenta(self.later), np.empty(velocity.shape)
        self.contact_map.mass.scale(momentum.reshape(-1, 6), change)
        return (velocity if kept is None else kept) + change

    def set_rate(self, world: World, momentum: Floats) -> None:
        """Give a cell that deforms the rate of its periods in this step, for the momenta of `velocity_with`;
        collective."""
        mass = self.contact_map.mass
        if isinstance(mass, CellMass):
            rate = mass.rate_of(momentum.reshape(-1, 6) + self._given)
            world.cell = replace(world.cell, rate=mass.cell.free + rate)

    def take_flow(self, world: World, contacts: Contacts) -> None:
        """Take the drift of the contacts from the shear and the rate of the cell."""
        flow = contacts.flow(world.cell, contacts.near.bodies.position)
        self.drift = None if flow is None else np.einsum("cij,cj->ci", self.frame, flow)

    def impulse_on_large(self, impulse: Floats, moment: Floats | None = None) -> Floats:
        """Impulses and angular impulses D g (large, 6) on the large bodies, the same on all ranks, from the impulses
        and the moments of `dem.step.resistance` (nc, 3) of all ranks [N s, N m s]; collective."""
        first = self.near.grains + self.near.ghosts
        sums = self.contact_map.sums_of_impulses(impulse, first)  # body b has the higher id
        if moment is not None and self.resistance is not None:
            rows = (self.contact_map.body[:, 1] >= first).nonzero()[0]
            self.resistance.map.sums_of_moments(moment, rows, sums)
        large = sums[first:].copy()
        self.contact_map.comm.Allreduce(MPI.IN_PLACE, large)
        return large

    def constraint_impulses(self, impulse: Floats, moment: Floats | None = None) -> Floats:
        """Impulses (k,) of the rows of constraints with these impulses and moments of contacts (nc, 3) [N s, N m s];
        collective."""
        if self.coupling is None:
            return np.zeros(0)
        return self.coupling.impulses(self._push(impulse, moment))

    def refound(self, world: World, impulse: Floats, velocity: Floats) -> UnconstrainedMotion | None:
        """The motion with other conditions and drives, where the impulses (parts nc, 3) of the cone problem and the
        velocities (owned, 6) show that other limits and motors hold, or that drives are too weak; else None.
        Collective."""
        known, coupling, saturated = self.motion, None, None
        if self.coupling is not None and self.coupling.decides:
            coupling = coupling_refound(world, self.coupling, self._push(*self.parts(impulse)))
        if world.large_moves and self.drives.bound.any():
            large = large_velocity(world, known, velocity)
            saturated = self.drives.refound(self.drive_impulse(large), large)
        if coupling is None and saturated is None:
            return None
        known = known if coupling is None else replace(known, coupling=coupling)
        return known if saturated is None else known.with_saturated(world, saturated)

    def _push(self, impulse: Floats, moment: Floats | None) -> Floats:
        """What contacts alone give the constrained bodies (n, 6), mass-scaled."""
        return self.problem_map.shared(impulse if moment is None else np.concatenate([impulse, moment]))

    def drive_impulse(self, large: Floats) -> Floats:
        """Impulses and angular impulses (large, 6) of the drives of large bodies, and of parts on them, that have the
        velocities `large` (large, 6) after the step."""
        if not self.drives.servo_inertia.any():
            return self.drives.impulse
        line, slip = self.drives.line, self.free_large - large
        return self.drives.impulse + (self.drives.servo_inertia * np.einsum("bi,bi->b", line, slip))[:, None] * line


def _parting(e: Floats, came: Floats, pressed: Floats, gap: Floats, dt: float) -> Floats:
    """The normal velocities (n,) in a step of dt [s] of contacts that bounce within it, and came with the velocities
    `came` (n,), while forces change these by -`pressed` (n,) [m/s], at gaps (n,) [m]: those with which bodies that
    meet at the surface, and leave it with e times the speed, come back to this gap. At e = 1 that is -came."""
    half = 0.5 * np.maximum(pressed, 0.0)
    fallen = 4.0 / dt * half * np.maximum(gap, 0.0)
    parts: Floats = np.sqrt(np.maximum(e**2 * ((half - came) ** 2 + fallen) - fallen, 0.0)) - half
    return parts


def _map_of(world: World, contacts: Contacts, frame: Floats, drives: Drives) -> ContactMap:
    """The map of contacts with these frames (nc, 3, 3), of bodies that nothing couples beside them; collective."""
    near, owned, table = contacts.near, world.owned, contacts.near.bodies
    moved = np.zeros((0, 3)) if contacts.moved is None else contacts.moved
    # the last rank, which owns the large bodies, has no ghosts: the own bodies are the first rows on all ranks
    row, body, touched, arm = _rows_of(
        contacts.a, contacts.b, near.index, table.mass, owned, contacts.point, moved, table.position
    )
    rows = CompactRows(frame.reshape(-1, 9), arm, body, inverse_root_masses(world, drives), owned)
    ghosts = touched.nonzero()[0]
    index = near.index[ghosts]
    owner = np.minimum(world.slabs.searchsorted(index, side="right"), world.comm.size) - 1
    halo = Halo(world.comm, owned, len(table), ghosts, owner, index - world.slabs[owner])
    return ContactMap(world.comm, rows, halo, row)


def gap_velocities(
    world: World, contacts: Contacts, dt: float, recovery_speed: float
) -> tuple[Floats, Floats, Floats]:
    """Return `dem.start.stiffness.gap_velocities` of these contacts."""
    table, rows = contacts.near.bodies, (contacts.a, contacts.b)
    return stiffness.gap_velocities(
        world.pairs.stiffness, table.material, table.mass, *rows, contacts.linear_gap, dt, float(recovery_speed)
    )


def inverse_root_masses(world: World, drives: Drives) -> Floats:
    """Return M^-1/2 of the bodies whose rows this rank owns, as `CompactRows.root` has it: (owned, 6) where that is all
    on all ranks, else (owned, 12)."""
    last = world.comm.rank == world.comm.size - 1
    large = with_servos(world.large, drives) if world.large_moves else world.large
    tables = [world.grains, large] if last else [world.grains]
    if world.only_spheres and not world.large_moves:
        parts = [_inverse_roots(table.mass, table.inertia) for table in tables]
        return np.concatenate(parts) if last else parts[0]
    out = np.concatenate([_inverse_roots_turned(table.mass, table.inertia, table.quaternion) for table in tables])
    if last and world.large_moves:
        guided = free_directions(world.large_bodies) / np.sqrt(tables[1].mass)[:, None, None]
        out[len(world.grains) :, :6] = guided.reshape(-1, 9)[:, UPPER]
    return out


@loop
def _expected(root: Floats, push: Floats, dt: float) -> Floats:
    """What mass-scaled momenta (n, 6) change of the velocities (n, 6). Of bodies that were struck both become zero."""
    change = np.empty(push.shape)
    for n in range(len(push)):
        p = push[n]
        new = scaled_row(root, n, p[0], p[1], p[2], p[3], p[4], p[5])
        struck = dt * max(abs(new[3]), abs(new[4]), abs(new[5])) > STRUCK
        for k in range(6):
            change[n, k] = 0.0 if struck else new[k]
            push[n, k] = 0.0 if struck else push[n, k]
    return change


@loop
def _inverse_roots(mass: Floats, inertia: Floats) -> Floats:
    out = np.empty((len(mass), 6))
    for n in range(len(mass)):
        last = max(n - 1, 0)
        same = n > 0 and mass[n] == mass[last]  # as the last body: many are
        out[n, :3] = out[last, 0] if same else 1.0 / np.sqrt(mass[n])
        for k in range(3):
            same = n > 0 and inertia[n, k] == inertia[last, k]
            out[n, 3 + k] = out[last, 3 + k] if same else 1.0 / np.sqrt(inertia[n, k])
    return out


@loop
def _inverse_roots_turned(mass: Floats, inertia: Floats, quaternion: Floats) -> Floats:
    """M^-1/2 of bodies of masses (n,) and principal moments (n, 3), turned by quaternions (n, 4), as rows (n, 12)."""
    out, way = np.zeros((len(mass), 12)), np.empty((3, 3))
    for n in range(len(mass)):
        out[n, 0] = out[n, 3] = out[n, 5] = 1.0 / np.sqrt(mass[n])
        w, x, y, z = quaternion[n, 0], quaternion[n, 1], quaternion[n, 2], quaternion[n, 3]
        way[0, 0], way[0, 1], way[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        way[1, 0], way[1, 1], way[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        way[2, 0], way[2, 1], way[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        to = 6
        for i in range(3):
            for j in range(i, 3):
                for k in range(3):
                    out[n, to] += way[i, k] / np.sqrt(inertia[n, k]) * way[j, k]
                to += 1
    return out


def with_servos(large: Bodies, drives: Drives) -> Bodies:
    """Return the large bodies with what servos add to their masses and to their moments about hinges."""
    if not drives.servo_inertia.any():
        return large
    mass, inertia = large.mass.copy(), large.inertia.copy()
    mass += drives.servo_inertia * drives.line[:, :3].any(axis=1)
    turns = drives.line[:, 3:].any(axis=1)
    inertia[:, 2] += drives.servo_inertia * turns  # the z axis of a hinged body is that of its hinge
    return replace(large, mass=mass, inertia=inertia)


def contact_arms(contacts: Contacts, position: Floats, row: np.ndarray) -> Floats:
    """Return vectors (nc, 6) from the centres of the two bodies of each contact, or of the image of the second, to its
    point; `row` (nc, 2) are the bodies' rows, uint32, in a table of positions (rows, 3) [m]."""
    moved = np.zeros((0, 3)) if contacts.moved is None else contacts.moved
    return _arms(contacts.point, moved, position, row)


@loop
def _arms(point: Floats, moved: Floats, position: Floats, row: np.ndarray) -> Floats:
    out = np.empty((len(row), 6))
    for c in range(len(row)):
        _set_arm(c, point, moved, position, row, out)
    return out


@inlined
def _set_arm(c, point, moved, position, row, out):
    for k in range(3):
        out[c, k] = point[c, k] - position[row[c, 0], k]
        out[c, 3 + k] = point[c, k] - position[row[c, 1], k]
        if len(moved):
            out[c, 3 + k] -= moved[c, k]


@loop
def _beyond(b, freely, rounding, frame, swing, impacts, compliance, held):
    """b + freely (nc, 3), zero where it is not beyond the `rounding` (nc,), less what tangential springs give that held
    the impulses `held` (nc, 2) before the step. First b gets the `swing` (nc, 3) along the surfaces, if there is any,
    where there are no `impacts` (nc,), which last no step."""
    out = np.empty((len(rounding), 3))
    for c in range(len(rounding)):
        if len(swing) and not impacts[c]:
            for k in range(1, 3):
                f, s = frame[c, k], swing[c]
                b[c, k] += f[0] * s[0] + f[2] * s[2] + f[1] * s[1]
        for k in range(3):
            speed = b[c, k] + freely[c, k]
            out[c, k] = 0.0 if abs(speed) <= rounding[c] else speed
        for k in range(2):
            out[c, 1 + k] -= compliance[c, 1] * held[c, k]
    return out


@loop
def _rows_of(a, b, index, mass, owned, point, moved, position):
    """Of contacts of bodies in the rows a and b (nc,): the rows (nc, 2), the `index` (nc, 2) of those that move, else
    -1, which rows that this rank does not own they touch and move, and the arms of `contact_arms`."""
    row, moving = np.empty((len(a), 2), np.uint32), np.empty((len(a), 2), np.int32)
    touched, arm = np.zeros(len(mass), np.bool_), np.empty((len(a), 6))
    for c in range(len(a)):
        row[c, 0], row[c, 1] = a[c], b[c]
        for k in range(2):
            n = row[c, k]
            moves = np.isfinite(mass[n])
            moving[c, k] = index[n] if moves else -1
            if n >= owned and moves:
                touched[n] = True
        _set_arm(c, point, moved, position, row, arm)
    return row, moving, touched, arm
