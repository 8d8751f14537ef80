"""One file per question to a calculator; `mdnum.audit.base.CHECKS` has them all."""
