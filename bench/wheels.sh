#!/usr/bin/env bash
# For a GPU machine without a network: bench/wheels.sh FOLDER [PYTHON_VERSION], where there is one, fetches what
# bench/gpu.sh needs beside torch, numpy and scipy; WHEELS=FOLDER bench/gpu.sh ... there installs what is missing.
set -euo pipefail
cd "$(dirname "$0")/.."
mkdir -p "${1:?usage: bench/wheels.sh FOLDER [PYTHON_VERSION, 3.12 by default]}"
PYTHON=${PYTHON:-$([ -x .venv/bin/python ] && echo .venv/bin/python || echo python3)}
TARGET=(--only-binary=:all: --implementation cp --python-version "${2:-3.12}")
for glibc in 2_28 2_27 2_26 2_24 2_17; do TARGET+=(--platform "manylinux_${glibc}_x86_64"); done
TARGET+=(--platform manylinux2014_x86_64)
"$PYTHON" -m pip download --quiet --no-deps --dest "$1" -c constraints.txt "${TARGET[@]}" \
  nanobind pytest pluggy iniconfig pygments packaging pytest-timeout hypothesis sortedcontainers \
  lightning lightning-utilities torchmetrics hydra-core omegaconf PyYAML rich markdown-it-py mdurl \
  scikit-learn joblib cloudpickle narwhals threadpoolctl scikit-image imageio lazy-loader tifffile pillow h5py tqdm \
  matplotlib contourpy cycler fonttools kiwisolver pyparsing python-dateutil six
"$PYTHON" -m pip wheel --quiet --no-deps --wheel-dir "$1" -c constraints.txt antlr4-python3-runtime # hydra's; a source alone
du -sh "$1"
