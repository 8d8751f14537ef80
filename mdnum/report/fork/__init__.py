"""The report of a fork folder: two runs that differ in one choice, or every choice screened."""
