"""`python -m tactomo.cli`: the same as `tactomo`, for child processes of the same interpreter."""

from tactomo.cli import main

main()
