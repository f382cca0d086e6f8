"""`python sanitized.py MODULE.so ISA PYTEST_ARGUMENTS...`:
tests on a build of the kernels that is watched.

Exit status 99: this machine has no such instruction set.
"""

import importlib.util
import sys

import pytest


def main() -> int:
    """Put the given module in the place of `gsparc.ops._native`, then run pytest."""
    name = "gsparc.ops._native"
    spec = importlib.util.spec_from_file_location(name, sys.argv[1])
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    import gsparc.ops

    gsparc.ops._native = module
    from gsparc.ops import native

    assert native._native.__file__ == sys.argv[1]
    if not module.use_instruction_set(sys.argv[2]):
        return 99
    return int(pytest.main(sys.argv[3:]))


if __name__ == "__main__":
    sys.exit(main())
