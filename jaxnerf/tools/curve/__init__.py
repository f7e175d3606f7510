"""Speed against error: what a run reaches after how many seconds; see `jaxnerf-report --curve`."""
