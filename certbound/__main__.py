"""``python -m certbound`` does what the installed ``certbound`` does."""

from certbound.cli import main

if __name__ == "__main__":
    main()
