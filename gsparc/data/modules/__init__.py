"""One `DataModule` per dataset, the `_target_` of conf/dataset; the loaders themselves need no Lightning."""
