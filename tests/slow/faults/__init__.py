"""What can go wrong around a run, at length: scripts run by hand. tests/test_faults.py has them in short."""
