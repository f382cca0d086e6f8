"""Train and test a method: `python train.py dataset=rfid model=gsparc dataset.root=DIR split=random`."""

from gsparc.training import main

if __name__ == "__main__":
    main()
