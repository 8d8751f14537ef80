"""`mdnum.Recorder`: records the flips of any simulation loop in a folder."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from mdnum.errors import InputError, MdnumError
from mdnum.reading import FrameError
from mdnum.registry import expect_known
from mdnum.trajectories.arrays import ArrayFrames, host, one_by_one
from mdnum.trajectories.listed import GivenList, ListCheck
from mdnum.trajectories.trajectory import SAMPLE
from mdnum.verbs.flips import WINDOW, FrameExamination, examining, rules
from mdnum.verbs.flips_loop import loop_told
from mdnum.verbs.flips_shared import about
from mdnum.verbs.frame import Outcome

if TYPE_CHECKING:
    from mdnum.forks.folders import FolderFork

# seconds between writes, and how many times what a write takes
_EVERY, _TIMES = 2.0, 50.0
_LOOK = "Examine what the loop did up to that step; all earlier records are kept"
_NONE = {name: np.zeros(0, np.int64) for name in ("rule", "i", "j", "rank", "entered")}


class Recorder:
    """Recorder of flips and of missing neighbors, for any simulation loop.

    The results are the same as from `mdnum.flips` for a file of the recorded frames. Pair decisions are
    computed from the positions in float64. Decisions that are uncertain because positions were rounded to
    float32 are marked.

    Example:
        >>> with mdnum.Recorder(8.5, box=box, fractional=True, out="runs/mine") as rec:
        ...     for step in range(1000):
        ...         state = apply(state, neighbor=neighbors)
        ...         rec.see(step, state.position, neighbors=neighbors)  # the list that its forces are from
        ...         neighbors = neighbors.update(state.position)
        >>> print(rec.outcome.verdict.headline)
        >>> dyn.attach(mdnum.Recorder(5.0, atoms=atoms), interval=1)

    Args:
        r_cut: one or more cutoffs, length; pairs by species, nearest neighbors and `most` as for `flips`.
        compare: "r2 <", "r2 <=", "r <" or "r <=", which decides whether a pair exactly at the cutoff is
            inside. The rounding of r is within the bound of a margin, and affects no decision here.
        atoms: ASE `Atoms`, for calls without arguments (`dyn.attach`); positions, box, species and, if the
            calculator provides it, the total energy are read from them.
        pair_energy: u(r), the energy of a pair at a distance up to the cutoff, as truncated there (with
            shifts): each flip is then recorded with its energy jump.
        between, window, out, report: as for `flips`.
        name: name of the loop on the page.
        arrays: `species`, a word or number for each atom; `cell` or `box` if frames are given without: one
            length, three, or a matrix with lattice vectors as rows (`cell`: ASE, torch, OpenMM) or as columns
            (`box`: jax-md); `pbc`, the periodic directions, by default all that have a vector; `fractional`,
            whether positions are fractions of the box (by default lengths), which is checked; `timestep`,
            which converts steps to times and is needed for velocities; `length` and `time`, names of units.

    Raises:
        InputError: an option cannot be used; in `see`, an array or a frame cannot be used (its positions are
            not finite, for example): earlier frames are kept.
        FolderError: the folder cannot be used.
    """

    def __init__(
        self, r_cut: float | Sequence[float] = (), *, pairs: Any = (), nearest: int | Sequence[int] = (),
        most: int | None = None, compare: str = "r2 <", atoms: Any = None,
        pair_energy: Callable[[float], Any] | None = None, between: tuple[str, str] | None = None,
        window: int = WINDOW, name: str = "loop", out: str | Path | None = None, report: bool = True,
        **arrays: Any,
    ) -> None:  # fmt: skip
        expect_known("comparison", [compare], ("r2 <", "r2 <=", "r <", "r <="), where="compare")
        if compare.endswith("="):
            r_cut = np.nextafter(np.atleast_1d(np.asarray(r_cut, float)), np.inf).tolist()
        self._rules = rules(r_cut, pairs, nearest, most)
        if not self._rules:
            raise InputError("no rule selects the pairs to record", remedy="Give r_cut, pairs or nearest")
        self._source, self._atoms = ArrayFrames(name, **arrays), atoms
        self._source.reach = max(one.reach for one in self._rules)
        self._how = {"between": between, "window": window, "out": out, "report": report, "live": True}
        rule, self._jump = self._rules[0], np.nan
        if pair_energy is not None:
            if len(self._rules) > 1 or (radius := getattr(rule, "radius", None)) is None or rule.directed:
                names = ", ".join(one.name for one in self._rules)
                raise InputError(
                    f"the argument pair_energy cannot be used with the selection of pairs by {names}",
                    remedy="Omit pair_energy, or select pairs by a single cutoff r_cut",
                )
            self._jump = float(pair_energy(radius))
        self._check = ListCheck(rule)
        # the list in use; energy, list and its flag of each frame that waits
        self._list: GivenList | None = None
        self._told: deque[tuple[float, GivenList | None, bool]] = deque()
        self._one: FrameExamination | None = None
        self._stack, self._failed = ExitStack(), None
        self._outcome: Outcome | None = None
        self._hooked = self._loop = False
        # frames that were given, and that were examined
        self._given = self._done = 0
        self._spent, self._written, self._cost = 0.0, -np.inf, 0.0

    def see(
        self, step: int, positions: Any, cell: Any = None, *, box: Any = None, pbc: Any = None,
        neighbors: Any = None, velocities: Any = None, energy: Any = None,
    ) -> None:  # fmt: skip
        """Record one frame. Arrays (numpy, jax or torch) are copied.

        Args:
            step: step of the loop.
            positions: (atoms, 3), length; or fractions of the box.
            cell, box, pbc: of this frame, if they differ from those of all frames.
            neighbors: the list in use: jax-md's `NeighborList`, (i, j) or (i, j, S) as in ASE, matscipy and
                vesin, or indices (2, pairs) or (atoms, neighbors); if omitted, the previous list.
            velocities: (atoms, 3), length per time, also if positions are fractions.
            energy: the energy that the integrator conserves.
        """
        began = perf_counter()
        if self._outcome is not None or self._failed is not None:
            raise self._failed or InputError("the recorder is closed", remedy="Create a new recorder")
        frame = self._source.read(step, positions, cell, box, pbc, velocities)
        if len(frame.positions) != self._source.atoms:
            message = f"step {step} has {len(frame.positions)} atoms; earlier steps had {self._source.atoms}"
            raise InputError(
                message, remedy="Use a separate recorder for each set of atoms", where="positions"
            )
        if neighbors is not None:
            self._list = self._check.given(neighbors, self._source.species)
        overflow = bool(np.any(np.asarray(getattr(neighbors, "did_buffer_overflow", False))))
        self._told.append((np.nan if energy is None else float(host(energy, "energy")), self._list, overflow))
        self._source.put(frame)
        self._given += 1
        if self._one is not None or self._given >= SAMPLE:
            self._advance()
        self._spent += perf_counter() - began

    def see_many(
        self, positions: Any, cell: Any = None, *, first: int = 0, every: int = 1, **given: Any
    ) -> None:
        """Record several frames: an array (frames, atoms, 3), or a list of arrays or `Atoms`.

        Args:
            first, every: step of the first frame, and number of steps between frames.
            cell, given: as for `see`, for all frames; energies and velocities as rows; boxes (unless a single
                one is given) and neighbor lists with one entry per frame.
        """
        for k, (frame, here) in enumerate(one_by_one(positions, {"cell": cell, **given})):
            if hasattr(frame, "get_positions"):
                self.see_atoms(frame, first + every * k)
            else:
                self.see(first + every * k, frame, **here)

    def see_atoms(self, atoms: Any, step: int | None = None) -> None:
        """Record ASE `Atoms`, or the present state of an ASE dynamics object."""
        step = int(getattr(atoms, "nsteps", self._given if step is None else step))
        atoms = getattr(atoms, "atoms", atoms)
        if self._source.named is None:
            self._source.named = atoms.get_chemical_symbols()
        found, speeds = getattr(atoms.calc, "results", {}), atoms.get_velocities()
        energy = found["energy"] + atoms.get_kinetic_energy() if "energy" in found else None
        self.see(step, atoms.positions, atoms.cell.array, pbc=atoms.pbc, velocities=speeds, energy=energy)

    def __call__(self, *args: Any, **given: Any) -> None:
        """Call `see` or, without arguments (as ASE dynamics objects call the recorder), `see_atoms`."""
        if len(args) > 1 or given:
            self.see(*args, **given)
        elif args or self._atoms is not None:
            self.see_atoms(*(args or (self._atoms,)))
        else:
            raise InputError(
                "the recorder was called without a frame", remedy="Give a frame, or use Recorder(atoms=...)"
            )

    def hook(self, step: Any, positions: Any, **given: Any) -> None:
        """Record a frame inside jax.jit, fori_loop or scan, by a host callback."""
        from jax.experimental import io_callback

        def seen(step: Any, positions: Any, given: Mapping[str, Any]) -> None:
            self.see(int(step), positions, **given)

        self._hooked = True
        io_callback(seen, None, step, positions, given, ordered=True)

    @property
    def outcome(self) -> Outcome:
        """Outcome of the recording, as from `mdnum.flips`; reading this attribute closes the recorder."""
        return self.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        # of a loop that failed, what came before is kept, and its own error goes on
        with suppress(*([MdnumError] if error is not None else [])):
            self.close(error)

    def close(self, error: BaseException | None = None) -> Outcome:
        """End the recording, compute the statistics, and return the outcome.

        Args:
            error: the exception that ended the loop early.

        Raises:
            InputError: no frame was recorded, or the first frame cannot be used.
        """
        if self._outcome is not None:
            return self._outcome
        if self._hooked:
            from jax import effects_barrier

            effects_barrier()
        began = perf_counter()
        if self._one is None and self._failed is None and self._given:
            self._advance()
        if self._one is None:
            raise self._failed or InputError("no frame was recorded", remedy="Call the method `see` first")
        one, folder = self._one, self._one.answer.folder
        with self._stack:
            self._add("lost", self._check.ended(self._done, one.found.rules[0].tracker.bound))
            one.rows.hand_over(folder)
            folder.merge()
            one.interrupted = error is not None and self._failed is None
            seconds, ended = self._spent + perf_counter() - began, type(error).__name__
            one.answer.summary = {"seconds": seconds, **loop_told(folder)}
            one.answer.summary |= {"ended_by": ended} if one.interrupted else {}
        self._outcome = one.answer.outcome
        return self._outcome

    def compare(self, other: Recorder) -> FolderFork:
        """Find the first frame at which two loops differ. Close both recorders."""
        from mdnum.forks.folders import compare_folders

        return compare_folders(self.outcome.path, other.outcome.path)

    def _advance(self) -> None:
        """Examine all recorded frames not yet examined, and write table rows at intervals."""
        try:
            if self._one is None:
                self._one = self._stack.enter_context(examining(self._source, self._rules, **self._how))
                # of a loop that is killed it remains
                told = {"rules": [{"rule": one.name} for one in self._rules], "status": "unfinished"}
                told |= about(self._source, "flips", self._how["between"])
                self._one.answer.folder.write_summary(told)
            one, rows, folder = self._one, self._one.rows, self._one.answer.folder
            while self._told:
                before = len(rows.held.get("flips", ()))
                # the first was examined to begin with
                if one.found.frames == self._done and next(one.passes, None) is None and one.found.stopped:
                    raise one.found.stopped
                self._after(one, rows.held.get("flips", [])[before:])
        except FrameError as error:
            # its remedy is about a file
            self._failed = failed = InputError(error.message, remedy=_LOOK, where=error.where)
            if self._one is not None:
                self._one.found.stopped = failed
            raise failed from None
        except MdnumError as error:
            self._failed = error
            raise
        now = perf_counter()
        due = now - self._written > max(_EVERY, _TIMES * self._cost)
        if due or rows.full:
            rows.hand_over(folder)
        if due:
            folder.flush("frames")
            self._written = perf_counter()
            self._cost = self._written - now

    def _after(self, one: FrameExamination, new: Sequence[dict[str, Any]]) -> None:
        """Record a frame's energy, and pairs that are missing from its neighbor list."""
        energy, listed, overflow = self._told.popleft()
        flips, frame = next((rows for rows in new if rows["rule"][0] == 0), _NONE), self._source.now
        for rows in new:
            rows["step"] = np.full(len(rows["i"]), frame.index)
        if new and not np.isnan(self._jump):
            flips["energy_jump"] = np.where(flips["entered"], self._jump, -self._jump)
        row: dict[str, Any] = {"listed": -1, "new_list": False, "lost": 0, "deepest": 0.0}
        if listed is not None:
            row, ended = self._check.step(frame, self._done, one.found.rules[0].tracker, flips, listed)
            self._add("lost", ended)
        self._loop |= listed is not None or bool(np.isfinite(energy))
        if self._loop:
            jump = self._jump * float(2 * np.count_nonzero(flips["entered"]) - len(flips["entered"]))
            row |= {"frame": self._done, "number": frame.index, "energy": energy, "energy_jump": jump}
            self._add("loop", [row | {"overflow": overflow}])
        self._done += 1

    def _add(self, table: str, rows: Sequence[Mapping[str, Any]]) -> None:
        if rows and self._one is not None:
            self._one.rows.add(table, {name: np.array([row[name] for row in rows]) for name in rows[0]})
