"""The config files of runs; `jaxnerf.configs` in the package. default.py lists every field."""
