"""Train and test a method: `python train.py dataset=rfid model=gsparc dataset.root=DIR split=random`."""

import os

if __name__ == "__main__":
    # Torch's threads would otherwise spin for one another: twenty times slower beside another busy process.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    from gsparc.training import main

    main()
