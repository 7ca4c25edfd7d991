"""``python -m sim2gp``: the command line where no script is on the path."""

from sim2gp.cli import entry

if __name__ == "__main__":
    entry()
