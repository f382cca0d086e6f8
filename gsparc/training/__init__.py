"""How the field learns: the LightningModule, initial values, schedules, time budget, resuming."""
