"""Variants that agree are found to, and what tells the others apart is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mdnum.errors import InputError, MdnumError
from mdnum.forks.child import positions_of
from mdnum.forks.variants import REFERENCE, VARIANTS, Ran, Variant, _causes, _clustered, variants
from mdnum.rollout.engine import Engine
from mdnum.systems.build import build
from mdnum.systems.load import System, load

# processes of their own
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def crystal() -> System:
    return load("argon/crystal-108", world="md")


def ran(name: str, hashes: str, seed: int | None = None) -> Ran:
    known = {variant.name: variant for variant in VARIANTS}
    return Ran(known.get(name, Variant(name)), tuple(hashes), -1, seed, 0.0, 1.0, "" if hashes else "no flag")


def test_equal_hashes_are_one_cluster_and_a_short_run_joins_whom_it_agrees_with():
    rows = [
        ran("scan", "abcd"),
        ran("eager", "ax", 2),
        ran("AVX", "axyz", 2),
        ran("bogus", ""),
        ran("x", "abcd"),
    ]
    assert [row.cluster for row in _clustered(rows)] == [0, 1, 1, -1, 0]


def test_fused_multiply_add_is_named_when_all_that_cannot_fuse_agree():
    avx = [ran("AVX", "axyz", 2), ran("SSE4.2", "axyz", 2), ran("unoptimized", "axyz", 2)]
    names = "AVX, SSE4.2, unoptimized"
    fused, plain = _causes([ran("scan", "abcd"), *avx, ran("eager", "ax", 2)])
    assert fused == ("fused", {"names": names, "step": 2}) and plain[0] == "eager_plain"
    (other,) = _causes([ran("scan", "abcd"), *avx[:2], ran("unoptimized", "awww", 2)])
    assert other[0] == "unlike"
    (none,) = _causes([ran("scan", "abcd"), ran("AVX", "abcd"), ran("SSE4.2", "abcd")])
    assert none == ("not_fused", {"names": "AVX, SSE4.2"})
    assert _causes([ran("scan", "abcd")]) == []


def test_a_batch_or_a_gradient_is_told_from_what_it_fuses():
    scan, avx = ran("scan", "abcd"), ran("AVX", "axyz", 2)
    fuses = _causes([scan, avx, ran("grad", "abyz", 3), ran("grad, AVX", "axyz", 2)])
    assert fuses[-1] == ("fuses", {"program": "grad", "step": 3})
    orders = _causes([scan, avx, ran("vmap", "abyz", 3), ran("vmap, AVX", "axxx", 2)])
    assert orders[-1] == ("ordered", {"program": "vmap", "step": 3})
    same = _causes([scan, ran("vmap", "abcd"), ran("reversed", "abxx", 3)])
    assert same == [("same", {"program": "vmap", "step": None}), ("reversed", {"step": 3})]


def test_a_program_is_the_trajectory_of_the_rollout_up_to_rounding(crystal: System):
    (segment,) = Engine(build(crystal), 30).segments()
    ours = np.array([segment.unsorted("x", row).T for row in range(1, 31)])
    box = np.diag(np.asarray(build(crystal).cell.matrix))[None, :, None]
    for program in ("scan", "rollout", "vmap"):
        x = positions_of(crystal, 30, program)
        assert x.shape == (30, 3, 108)
        d = x - ours
        assert np.abs(d - box * np.round(d / box)).max() < 1e-13


def test_a_program_ends_before_its_list_is_used_up():
    liquid = load("argon/liquid-864", {"neighbors.skin": 0.1}, world="md")
    x = positions_of(liquid, 120, "rollout")
    home = build(liquid).positions
    box = np.diag(np.asarray(build(liquid).cell.matrix))
    d = x.transpose(0, 2, 1) - home
    moved = np.linalg.norm(d - box * np.round(d / box), axis=2).max(axis=1)
    assert 0 < len(x) < 120
    # twice the skin that was asked for, half of it used
    assert moved[-1] <= 0.1 < 0.11 and moved[-1] > 0.09


@pytest.mark.usefixtures("strangers_folder")
def test_in_processes_of_their_own_flags_order_and_faults_show(crystal: System):
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
    assert "reversed" in dict(found.causes)
    assert not avx.failed and len(avx.hashes) == 40
    assert bogus.failed and bogus.cluster == -1 and "xla_no_such_flag" in bogus.failed
    # where this machine fuses, the flag is seen to do something
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists() and " fma " in cpuinfo.read_text(encoding="utf-8"):
        assert avx.cluster > 0 and avx.first_bit is not None
    assert not any("bogus" in names for names in found.clusters)


def test_what_cannot_be_run_is_refused(crystal: System):
    with pytest.raises(InputError, match="many-body"):
        variants(load("silicon/tersoff-512", world="md"))
    with pytest.raises(InputError, match="at least one step"):
        variants(crystal, 0)
    with pytest.raises(InputError, match="at least one step and one variant"):
        variants(crystal, 10, [])
    with pytest.raises(MdnumError, match="no variant ran; 'bogus' said"):
        variants(crystal, 2, [Variant("bogus", flags=("--xla_no_such_flag=1",))])
