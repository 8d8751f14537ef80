"""What one should know before relying on a comparison of two trajectories."""

from __future__ import annotations

from collections.abc import Iterator

from mdnum.report.flips.conclusions import shown, views
from mdnum.report.flips.words import box_words, frame, merged, rule_words
from mdnum.report.fork.question import Question
from mdnum.report.verdict import Finding
from mdnum.report.words import count, many


def findings(run: Question) -> Iterator[Finding]:
    """What one should know before relying on the comparison."""
    summary = run.summary
    if summary["stopped"]:
        frames = many(summary["frames"], "frame")
        yield Finding(
            "STOPPED",
            "error",
            f"the comparison ends after {frames}",
            f"{summary['stopped']} Everything here is about the {frames} before.",
            "Check how that file was written.",
        )
    if summary.get("interrupted"):
        yield Finding(
            "INTERRUPTED",
            "warning",
            f"stopped by hand after {many(summary['frames'], 'frame')}",
            "Everything here is about those.",
            "Look at the rest with a slice of the frames behind either path, or at all of them again.",
        )
    yield from merged(found for one in views(run) for found in _within(one))
    yield from _boxes(run)
    if any(one["first"] is not None for one in summary["rules"]) and shown(run):
        yield Finding(
            "NO_CAUSE_FROM_FILES",
            "info",
            "a flip that came first is no cause",
            "To tell, the program has to run again with the other run's decisions.",
            "Two runs of mdnum: mdnum fork RUN_A RUN_B --replay. A system of mdnum: mdnum fork SYSTEM --vary "
            "CHOICE. Another program: make one run with a smooth cutoff, and see whether they still part.",
        )
    if not summary["same_species"]:
        yield Finding(
            "OTHER_SPECIES",
            "warning",
            "the two files name different species",
            "Atoms are compared by their numbers. If they are in another order in one of the files, nothing "
            "here means anything.",
            "Check that both files have their atoms in the same order.",
        )
    if summary["times_differ"]:
        yield Finding(
            "OTHER_TIMES",
            "warning",
            f"times differ at {many(summary['times_differ'], 'frame')}",
            "Frames are compared one by one in the order of the files, whatever their times.",
            "Choose frames of the same times with @START:STOP:STEP on either path.",
        )
    if (times := summary.get("times")) and times[0] != times[1]:
        a, b = (f"counts {one}s" if one in ("frame", "step") else f"is in {one}" for one in times)
        yield Finding(
            "NO_TIMES",
            "info",
            "times of the two files cannot be compared",
            f"That of A {a}, that of B {b}. Frames are compared one by one in the order of the files.",
        )
    counts = [one for one in summary["in_file"] if one is not None]
    if len(set(counts)) > 1 and not summary["stopped"] and not summary.get("interrupted"):
        yield Finding(
            "OTHER_LENGTH",
            "info",
            f"one has {many(min(counts), 'frame')}, the other {count(max(counts))}",
            "Those that both have are compared.",
        )


def _within(run: Question) -> Iterator[Finding]:
    """Sets that differ first by pairs about which the files cannot tell."""
    first, certain = run.summary["first"], run.summary["certain"]
    if first is None or certain == first["frame"]:
        return
    sure = "no pair ever differs" if certain is None else f"a pair differs first at {frame(run, certain)}"
    several = f"{rule_words(run, run.summary)}: at " if len(run.summary["rules"]) > 1 else "At "
    yield Finding(
        "WITHIN_RESOLUTION",
        "warning" if shown(run) else "info",
        "the first pairs that differ are within the files’ resolution",
        f"{several}{frame(run, first['frame'])} it may be rounding alone; {sure} by more than the resolution "
        "explains. Every pair that is inside in one file only there is so close to the threshold that "
        "rounding may have put it there.",
        "Take the frame that is certain, or write positions with more digits." if shown(run) else "",
    )


def _boxes(run: Question) -> Iterator[Finding]:
    """Boxes or axes of repetition that are not the same."""
    found, beyond = run.summary["other_box"], run.summary["beyond"]
    if found is None:
        return
    # two runs at constant pressure have two boxes once they have parted
    parted = not found["axes"] and beyond is not None and 0 < beyond <= found["frame"]
    what = "repeat along different axes" if found["axes"] else "have different boxes"
    yield Finding(
        "OTHER_BOX",
        "info" if parted else "warning",
        f"the two {what} from {frame(run, found['frame'])} on",
        f"A: {box_words(run, found['a'])}. B: {box_words(run, found['b'])}. Each file’s pairs are those of "
        "its own box; how far atoms are apart is told through the box of B, along axes that repeat in both."
        + (" The boxes came to differ after the positions did, as with a barostat." if parted else ""),
        "" if parted else "Check that both files are of one system, and that both keep their boxes.",
    )
