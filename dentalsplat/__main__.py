"""``python -m dentalsplat`` is the command ``dentalsplat``."""

from dentalsplat.command import main

if __name__ == "__main__":
    main()
