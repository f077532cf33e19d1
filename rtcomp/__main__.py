"""`python -m rtcomp` is `rtcomp`."""

from rtcomp.cli import main

main()
