"""Variants that agree are found to, and what tells the others apart is named."""

from __future__ import annotations

from pathlib import Path

import pytest
from rollout.harness import furthest, history

import mdnum
from mdnum.errors import InputError, MdnumError
from mdnum.forks import processes
from mdnum.forks.processes import (
    REFERENCE,
    VARIANTS,
    Ran,
    Variant,
    causes_of,
    clustered,
    positions_of,
    variants,
)
from mdnum.systems.build import build
from mdnum.systems.simulation import Simulation
from mdnum.verbs.fork_certify import TEXTS

# processes of their own
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def crystal() -> Simulation:
    return build("argon/crystal-108")


def ran(name: str, hashes: str, first_bit: int | None = None) -> Ran:
    known = {variant.name: variant for variant in VARIANTS}
    failed = "" if hashes else "no flag"
    return Ran(known.get(name, Variant(name)), tuple(hashes), failed, first_bit=first_bit)


SCAN, AVX = ran("scan", "abcd"), ran("AVX", "axyz", 2)
NO_FMA = [AVX, ran("SSE4.2", "axyz", 2)]


def test_equal_hashes_are_one_cluster_and_a_short_run_joins_whom_it_agrees_with():
    rows = [SCAN, ran("eager", "ax", 2), AVX, ran("bogus", ""), ran("x", "abcd")]
    assert [row.cluster for row in clustered(rows)] == [0, 1, 1, -1, 0]


@pytest.mark.parametrize(
    ("rows", "causes"),
    [
        ([], []),
        # fused multiply-add is named when all that cannot fuse agree
        (
            [*NO_FMA, ran("unoptimized", "axyz", 2), ran("eager", "ax", 2)],
            [("fused", 2), ("eager_plain", None)],
        ),
        ([*NO_FMA, ran("unoptimized", "awww", 2)], [("others", None)]),
        ([ran("AVX", "abcd"), ran("SSE4.2", "abcd")], [("not_fused", None)]),
        ([ran("eager", "ay", 2)], [("eager_leaves", 2)]),
        ([AVX, ran("eager", "a")], [("eager_short", None)]),
        # a batch or a gradient is told from what it fuses
        ([AVX, ran("grad", "abyz", 3), ran("grad, AVX", "axyz", 2)], [("fuses", 3)]),
        ([AVX, ran("vmap", "abyz", 3), ran("vmap, AVX", "axxx", 2)], [("orders", 3)]),
        ([ran("rollout", "abyz", 3)], [("leaves", 3)]),
        ([ran("vmap", "abcd"), ran("reversed", "abxx", 3)], [("same", None), ("reversed", 3)]),
    ],
)
def test_the_pattern_of_agreement_tells_the_cause(rows, causes):
    found = list(causes_of([SCAN, *rows]))
    assert [(cause["code"], cause.get("step")) for cause in found] == causes
    assert all(f"cause_{cause['code']}" in TEXTS.entries["sentences"] for cause in found)


def test_a_program_is_the_trajectory_of_the_rollout_up_to_rounding(crystal: Simulation):
    ours, _ = history(crystal, 30)
    for program in ("scan", "rollout", "vmap"):
        x = positions_of(crystal, 30, program)
        assert x.shape == (30, 3, 108)
        assert furthest(crystal, x.transpose(0, 2, 1), ours[1:]).max() < 1e-13


def test_a_program_ends_before_its_list_is_used_up():
    simulation = build("argon/liquid-864", {"neighbors.skin": 0.1})
    x = positions_of(simulation, 120, "rollout")
    moved = furthest(simulation, x.transpose(0, 2, 1), simulation.positions)
    assert 0 < len(x) < 120
    # twice the skin that was asked for, half of it used
    assert moved[-1] <= 0.1 < 0.11 and moved[-1] > 0.09


@pytest.mark.usefixtures("strangers_folder")
def test_in_processes_of_their_own_flags_order_and_faults_show(crystal: Simulation):
    told: list[tuple[int, int]] = []
    known = {variant.name: variant for variant in VARIANTS}
    which = (
        REFERENCE,
        Variant("again"),
        known["AVX"],
        known["reversed"],
        Variant("bogus", flags=("--xla_no_such_flag=1",)),
    )
    found = variants(crystal, 40, which, progress=lambda done, total, name: told.append((done, total)))
    assert sorted(told) == [(k, 5) for k in range(1, 6)]
    scan, again, avx, reverse, bogus = found.rows
    assert scan.cluster == again.cluster == 0 and again.first_bit is None and again.separation == 0
    assert len(scan.hashes) == found.steps == 40
    # another order of the sum is another program on every machine
    assert reverse.cluster > 0 and reverse.first_bit is not None and 0 < reverse.separation < 1e-12
    assert "reversed" in [cause["code"] for cause in found.causes]
    assert not avx.failed and len(avx.hashes) == 40
    assert bogus.failed and bogus.cluster == -1 and "xla_no_such_flag" in bogus.failed
    # where this machine fuses, the flag is seen to do something
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists() and " fma " in cpuinfo.read_text(encoding="utf-8"):
        assert avx.cluster > 0 and avx.first_bit is not None
    assert not any("bogus" in names for names in found.clusters)


def test_what_cannot_be_run_is_refused(crystal: Simulation, tmp_path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(InputError, match="many-body"):
        variants(build("silicon/tersoff-512"))
    with pytest.raises(InputError, match=r"steps = 0: .*one step"):
        variants(crystal, 0)
    with pytest.raises(InputError, match=r"steps = 10: .*one variant"):
        variants(crystal, 10, [])
    # another process has none of the objects of this one
    with pytest.raises(InputError, match="objects"):
        mdnum.fork_processes(crystal.with_cutoff("quintic"), steps=2, out=tmp_path / "of-objects")
    assert not (tmp_path / "of-objects").exists()
    monkeypatch.setattr(processes, "_ask", lambda *_, **options: "no such flag")
    with pytest.raises(MdnumError, match=r"'bogus'.*: no such flag"):
        variants(crystal, 2, [Variant("bogus")])
