"""Faults around a run, as scripts that are run by hand; tests/training/test_faults.py has the short versions."""
