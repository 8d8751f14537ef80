"""Two runs that differ in one numerical choice: where they diverge, and whether a flip did it."""

import mdnum

fork = mdnum.fork("argon/crystal-108", "precision", steps=400)
print(fork.verdict.headline)
print("first bit at step", fork.summary["first_bit"], "- fork at", fork.summary["fork"])
for finding in fork.verdict.findings:
    print(finding.severity, finding.code)
