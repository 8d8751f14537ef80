"""The command lines whose answers are frozen: what is called, in which order, and which of it is compared.

Spellings of commands and paths into summaries stand here alone; the records beside this file know names only.

`numbers` are words `LABEL=PATH~TOLERANCE` into the JSON document of the command: the label is the path where it
is left out, the tolerance (relative to the largest of a list) 1e-6. `~<LIMIT` asks only whether what should be
zero is within LIMIT. A path is keys with dots between; `[]` goes through a list, and `{}` through the values of a
mapping, which is recorded with its keys.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Golden:
    """One command: its arguments, the numbers of its document and the tables of its folder.

    needs: goldens that run before it, whose folders it reads.
    out: it leaves a folder of its own name, given by -o.
    tables: parquet tables of that folder; a table without bounds of what moves in the last bits.
    loose: relative tolerance of columns of the tables.
    """

    name: str
    arguments: str
    numbers: Sequence[str] = ()
    tables: str = ""
    needs: str = ""
    out: bool = True
    loose: float = 1e-6
    slow: bool = False

    @property
    def words(self) -> list[str]:
        import shlex

        return shlex.split(self.arguments)

    @property
    def verb(self) -> str:
        return self.name.partition("-")[0]


RUN = (
    "status", "atoms", "steps", "time", "flips_entered", "flips_left", "pairs_first", "pairs_last",
    "algebra_residual", "rebuilds", "dangerous_builds", "count_mismatches", "lost_pairs", "ambiguous",
    "ambiguous_flips", "energy_drift", "energy_budget_closes",
    "cutoff.smoothness", "cutoff.bound", "cutoff.radius", "ase.reference", "ase.energy_rel~<1e-6", "ase.ok",
)  # fmt: skip

FORK = (
    "choice", "must_hold", "atoms", "steps", "seed", "fork", "split", "verdict", "decision.i", "decision.j",
    "decision.run", "decision.entered", "decision.step", "decision.margins~1e-4", "decision.ambiguous", "splits",
    "handed_until", "cross_flips", "table[].arithmetic", "table[].decisions", "table[].from", "table[].split",
    "repeated[].free", "certified_horizon", "ambiguous", "lists_complete", "protected_until", "shadow", "status",
    "lyapunov.rate~1e-4",
)
FORK_TABLES = "cross_flips ambiguous_pairs separation neighborhood"
ALONG = (
    "status", "key", "value", "histories", "complete", "evaluations", "failed_runs", "confirmed", "jump_largest",
    "boundaries[].below", "boundaries[].step", "boundaries[].i", "boundaries[].j", "boundaries[].way",
    "boundaries[].jump", "boundaries[].confirmed", "intervals[].history",
)
FORECAST = ("status", "first[].step", "first[].i", "first[].j", "first[].amplitude", "nearest[].step",
    "nearest[].amplitude", "until", "ends", "examined")

CERTIFY = ("status", "flips", "smallest_margin", "smallest_margin_step", "policies[].name", "policies[].horizon",
    "policies[].pair", "policies[].state", "policies[].force", "policies[].decision", "policies[].accumulate",
    "ambiguous{}.total")
GRAD = (
    "status", "steps", "loss.word", "value", "parameters[].name", "reference", "exact", "methods[].method",
    "methods[].value", "methods[].gradient", "comparisons[].name", "comparisons[].method", "comparisons[].means",
    "growth.word", "growth.rate~1e-4", "flips.flips", "flips.grazing", "flips.smooth", "flips.total",
    "trust.verdict", "trust.horizon", "trust.limited_by", "trust.half~1e-5", "trust.digits", "refused[].method",
    "left_out[].what",
)
GRAD_TABLES = "growth flip_contributions"

FLIPS = (
    "status", "frames", "atoms", "rules[].name", "rules[].flips", "rules[].pairs_first", "rules[].pairs_last",
    "rules[].pairs_mean", "fork", "seed", "first", "certain",
)
AUDIT = (
    "status", "atoms", "formula", "safe_to_run", "safe_to_differentiate", "parts[].name", "parts[].asked",
    "parts[].numbers.ways", "parts[].numbers.told_apart", "parts[].numbers.disagree", "parts[].numbers.directions",
    "parts[].numbers.rms_force", "parts[].numbers.with_work", "parts[].numbers.largest_curl~1e-4", "causes[].code",
    "causes[].below",
)
CONFORM = (
    "status", "kept", "full", "shift_sign", "precision", "superset", "found_out", "ties", "keeps_order", "shifts",
    "questions", "asked", "left", "wrong", "silent", "conforms", "areas[].area", "areas[].asked", "areas[].passed",
    "areas[].failed", "areas[].silent", "areas[].refused", "areas[].skipped", "failures[].code",
    "failures[].area", "failures[].atoms", "failures[].alone", "refusals[].case",
)
FORK_BALL = (
    "choice", "must_hold", "balls", "steps", "seed", "fork", "split", "verdict", "decision.channel", "decision.ball",
    "decision.run", "decision.entered", "decision.step", "decision.decided", "decision.margins~1e-4",
    "decision.ambiguous", "splits", "handed_until", "cross_flips", "cross_contacts", "cross_stops",
    "table[].arithmetic", "table[].decisions", "table[].from", "table[].split", "repeated[].free", "shares[].what",
    "shares[].steps", "separation_end~1e-4", "status",
)
BALL = (
    "status", "balls", "steps", "time", "flips_entered", "flips_left", "first_contact", "iterations_total", "ended",
    "ambiguous", "ambiguous_contacts", "ambiguous_stops", "loss", "gradient[].method", "gradient[].gradient~1e-5",
    "gradient[].depends", "gradient[].refused", "exact.gradient", "exact.height_error~1e-4", "variants[].name",
    "variants[].seed", "variants[].fork", "variants[].channel", "variants[].ball", "variants[].contacts_differ",
    "variants[].iterations_total", "variants[].loss~1e-5",
)
DEMO = ("name", "ok", "checks[].ok", "numbers~1e-5", "tables[].columns")

FILES = {
    "whirl.py": "from audit.planted import Whirl\n\ncalculator = Whirl()\n",
    "planted_pairs.py": (
        f"import sys\n\nsys.path.append({str(Path(__file__).parents[1])!r})\n"
        "from planted_lists import planted\n\npairs, right = planted('no images'), planted('')\n"
    ),
}

C108 = "argon/crystal-108"
WELL = "pair/leaving-well"
GOLDENS = (
    Golden("run-crystal", f"run {C108} --steps 40 --save-every 4", RUN, "flips series epochs"),
    Golden("run-switched", f"run {C108} --steps 20 --set cutoff.kind=switched --no-report", RUN, "flips series"),
    Golden("run-float32", f"run {C108} --steps 40 --save-every 4 --set precision.force=float32 --no-report", RUN, "flips"),
    Golden("run-all-float32", f"run {C108} --steps 20 --set precision.state=float32 --set precision.force=float32 --set precision.decision=float32 --set precision.accumulate=float32 --no-check --no-report", RUN, "flips"),
    Golden("run-lattice", f"run {C108} --steps 20 --set precision.state=lattice --set cutoff.kind=quintic --no-check --no-report", RUN, "flips series"),
    Golden("run-tilted", "run argon/tilted-500 --steps 10 --no-report", RUN, "flips series"),
    Golden("run-langevin", "run argon/langevin-500 --steps 10 --no-report", RUN, "flips series"),
    Golden("run-liquid", "run argon/liquid-864 --steps 10 --no-report", RUN, "flips series"),
    Golden("run-silicon", "run silicon/stillinger-weber-512 --steps 3 --no-report", RUN, "flips series"),
    Golden("run-binary", "run binary/kob-andersen-1000 --steps 5 --no-report", RUN, "flips series"),
    Golden("run-pair", "run pair/at-cutoff --no-report --no-check", RUN, "flips series"),
    Golden("run-resumed", "run --resume run-crystal", RUN, "", "run-crystal", out=False),
    Golden("fork-choices", "fork", ("choices[].name", "choices[].must_hold", "ball_choices[].name", "ball_choices[].must_hold"), out=False),
    Golden("fork-precision", f"fork {C108} --vary precision.force=bfloat16 --steps 80 --repeats 4 --split 1e-3", FORK, FORK_TABLES),
    Golden("fork-exact", f"fork {C108} --vary reduction=exact --steps 60 --repeats 0 --no-back --no-lyapunov --no-report", FORK),
    Golden("fork-must-hold", f"fork {C108} --vary skin@exact --steps 30 --repeats 0 --no-back --no-lyapunov --no-report", FORK),
    Golden("fork-minimal", f"fork {C108} --vary precision.force=bfloat16 --steps 80 --repeats 0 --split 1e-3 --no-back --no-lyapunov --no-report --minimal --pin fork", (*FORK, "minimal.proven", "minimal.tests", "minimal.candidates", "pinned.pairs", "pinned.split")),
    Golden("fork-along", f"fork {WELL} --along sigma=0.99:1.01 --steps 1000 --most 2 --no-report", ALONG, "boundaries intervals"),
    Golden("fork-forecast", f"fork {C108} --forecast 1e-6 --steps 60 --no-report", FORECAST, "foretold reach"),
    Golden("fork-certify", f"fork {WELL} --certify --steps 20 --no-report", CERTIFY),
    Golden("fork-folders", "fork run-crystal run-float32", ("steps", "seed", "fork", "differences", "status", "decisions[].i", "decisions[].j"), "", "run-crystal run-float32", out=False),
    Golden("fork-screen", f"fork {WELL} --vary all --steps 20 --repeats 0 --no-report", (), slow=True),
    Golden("fork-processes", f"fork {C108} --processes --steps 3 --no-report", (), slow=True),
    Golden("forkball-contact", "fork ball/stiff --vary contact=earlier --steps 300 --repeats 4", FORK_BALL, "cross_flips separation around"),
    Golden("forkball-precision", "fork ball/drop --vary precision=float16 --steps 600 --repeats 4 --no-report", FORK_BALL, "cross_flips"),
    Golden("forkball-along", "fork ball/drop --along k=9000:11000 --steps 500 --most 3 --no-report", ALONG, "boundaries intervals"),
    Golden("forkball-certify", "fork ball/drop --certify --steps 80 --set contact.k=512 --set integrator.timestep=0.015625 --set start.height=0.40625 --set flight.gravity=9.75", ("steps", "ranking[].policy", "ranking[].horizon", "ranking[].channel", "ranking[].ball"), out=False),
    Golden("grad-well", f"grad {WELL} --of msd --wrt epsilon,r_cut --steps 120 --set dynamics.timestep=0.01 --methods symmetric,forward,unrolled,epochs,recursive,event-aware,finite-differences,surrogate,reversible --no-report", GRAD, GRAD_TABLES),
    Golden("grad-crystal", f"grad {C108} --of potential --wrt epsilon --steps 10 --methods symmetric,finite-differences --set cutoff.kind=switched --no-report", GRAD, "growth"),
    Golden("grad-reversible", f"grad {C108} --of potential --wrt epsilon --steps 10 --methods reversible --set precision.state=lattice --set cutoff.kind=quintic --no-half-step --no-report", GRAD),
    Golden("gradball-zeno", "grad ball/zeno --wrt restitution --methods event-aware,implicit --no-report", GRAD),
    Golden("gradball-drop", "grad ball/drop --steps 600 --no-report", GRAD),
    Golden("flips-run", "flips run-crystal", FLIPS, "", "run-crystal"),
    Golden("flips-file", "flips run-crystal/trajectory.traj --cutoff 1.6 --nearest 12 --no-report", FLIPS, "", "run-crystal"),
    Golden("flips-two", "flips run-crystal/trajectory.traj run-float32/trajectory.traj --cutoff 1.5874 --no-report", FLIPS, "", "run-crystal run-float32"),
    Golden("audit-lj", "audit 'ase.calculators.lj:LennardJones(sigma=3.405, epsilon=0.0103, rc=8.5)' --checks invariance,forces --no-report", AUDIT),
    Golden("audit-emt", "audit ase.calculators.emt:EMT --checks state", AUDIT),
    Golden("audit-whirl", "audit whirl.py --checks forces,curl", AUDIT),
    Golden("conform-planted", "conform planted_pairs.py:pairs --cases 10 --no-large", CONFORM),
    Golden("conform-right", "conform planted_pairs.py:right --cases 5 --no-large --no-report", CONFORM),
    Golden("conform-ase", "conform ase --cases 4 --no-large --no-report", CONFORM, slow=True),
    Golden("ball-drop", "ball ball/drop --steps 600 --against precision.decision=float32", BALL, "contacts heights separations"),
    Golden("ball-batch", "ball ball/batch-on-the-boundary --no-report", BALL, "contacts solver"),
    Golden("ball-zeno", "ball ball/zeno --no-report", BALL, "contacts"),
    Golden("ball-demo-sum-order", "ball --demo sum-order", DEMO),
    Golden("ball-demo-stopping-precision", "ball --demo stopping-precision --no-report", DEMO, out=False),
    Golden("ball-demo-saltation", "ball --demo saltation --no-report", DEMO, out=False),
    Golden("check-energy", f"check energy {C108}", ("ok", "reference", "frames[].frame", "frames[].energy", "frames[].force_scale", "frames[].ambiguous", "frames[].ok"), out=False),
    Golden("check-pairs", f"check pairs {C108}", ("ok", "r_cut", "pairs", "decided_exactly", "results[].finder", "results[].verdict", "results[].pairs", "results[].missing", "results[].extra", "results[].effective.ulps", "results[].effective.comparison"), out=False),
    Golden("check-dynamics", f"check dynamics {C108}", ("ok",), out=False),
    Golden("systems-list", "systems list", ("rows[].name", "rows[].atoms", "rows[].balls", "systems[].name"), out=False),
    Golden("systems-show", f"systems show {C108}", ("",), out=False),
    Golden("systems-check", f"systems check {WELL}", ("ok", "atoms", "system"), out=False),
    Golden("systems-copy", f"systems copy {WELL} copied", (), out=False),
    Golden("report", "report flips-run", ("report",), "", "flips-run", out=False),
    Golden("doctor", "doctor", ("ok", "checks[].name", "checks[].ok"), out=False),
)  # fmt: skip
