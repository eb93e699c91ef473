"""``python -m r3dpa``: the same as the ``r3dpa`` command."""

from r3dpa.cli import main

main()
