"""Train and test a method:
`python train.py dataset=rfid model=gsparc dataset.root=DIR split=random`.
"""

if __name__ == "__main__":
    from gsparc.commands.listing import COMMANDS

    COMMANDS["train"].run()
