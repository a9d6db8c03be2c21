"""``python -m idam`` and ``torchrun -m idam``."""

from idam.cli import main

main()
