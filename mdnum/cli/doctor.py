"""`mdnum doctor`: test this installation."""

from __future__ import annotations

from mdnum.cli import output


def doctor(as_json: bool = output.JSON_OPTION) -> int:
    """Test the numbers this installation computes."""
    from mdnum.doctor import diagnose

    diagnosis = diagnose()
    if as_json:
        output.print_json(diagnosis.to_dict())
    else:
        rows = [(row.status, row.name, row.seen) for row in diagnosis.rows]
        output.print_table("", ("status", "test", "seen"), rows)
        for row in diagnosis.rows:
            if row.remedy:
                output.say(f"{row.name}: {row.remedy}")
        verdict = "safe" if diagnosis.ok else "UNSAFE: do not trust numbers computed here"
        output.say(f"this installation is {verdict} ({diagnosis.seconds:.1f} s)")
    return output.EXIT_FINE if diagnosis.ok else output.EXIT_FINDINGS
