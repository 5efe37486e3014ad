"""`python -m spadwarp` is the `spadwarp` command."""

from spadwarp.cli import main

main()
