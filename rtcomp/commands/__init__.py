"""The commands of `rtcomp`: one module each, with a click command object `command`."""
