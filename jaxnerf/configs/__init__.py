"""The config files of runs; `jaxnerf.configs` in the package. docs/configuration.md lists every option."""
