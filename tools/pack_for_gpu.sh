#!/bin/bash
# Packs what a GPU machine without network needs: tools/pack_for_gpu.sh OUT [ARCHITECTURE] [PYTHON_VERSION]
#
#   OUT/warp.tar.xz      Warp, its native library with the machine code of one architecture only (some 70 MiB)
#   OUT/clang.tar.xz     Warp's compiler for the CPU, which whatever runs on the CPU needs
#   OUT/libraries.tar.xz plyfile, tyro and what they need
#   OUT/project.tar.xz   this repository at HEAD, without pictures
#   OUT/gsplat.tar.xz    the sources of gsplat 1.5.3, to be built there for the comparison
#
# There: mkdir site; for f in warp clang libraries project; do tar xf $f.tar.xz -C site; done
#        export PYTHONPATH=$PWD/site/project:$PWD/site
#        cd site/project && python -m benchmarks.gpu --page docs/gpu.md
#        SGWARP_TEST_DEVICE=cuda python -m pytest tests/ops tests/compat
# gsplat goes into a folder of its own, named in PYTHONPATH only for the comparison: the tests would compare with it.
# Packing takes four minutes of processor time, on as many cores as there are.
# Needs, here, bash, python3 with pip, xz and network; there torch, numpy, opencv, rich, safetensors and pytest.
set -euo pipefail

out=${1:?where to put the archives}
architecture=${2:-90}
python=${3:-3.12}
mkdir -p "$out"
out=$(cd "$out" && pwd)
root=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

python3 -m pip download --quiet --no-deps --only-binary=:all: --python-version "$python" \
    --platform manylinux_2_28_x86_64 --platform manylinux2014_x86_64 --platform any --dest "$work/wheels" \
    'warp-lang>=1.19,<1.20' gsplat==1.5.3 'plyfile>=1.0' 'tyro>=0.9' docstring-parser typeguard typing-extensions

unpack() {  # WHEEL FOLDER
    mkdir -p "$2"
    for wheel in "$work/wheels/$1"-*.whl; do python3 -m zipfile -e "$wheel" "$2"; done
}
pack() {  # FOLDER ARCHIVE
    tar c -C "$1" . | xz -T0 --x86 --lzma2=preset=6 > "$2.part"  # with 9e Warp alone takes too long to wait for
    mv "$2.part" "$2"
}

unpack warp_lang "$work/warp"
python3 "$root/tools/keep_one_architecture.py" "$work/warp/warp/bin/warp.so" "$architecture"
mkdir -p "$work/clang/warp/bin"
mv "$work/warp/warp/bin/warp-clang.so" "$work/clang/warp/bin/"
rm -rf "$work/warp/warp/tests" "$work/warp/warp/examples"
pack "$work/warp" "$out/warp.tar.xz"
pack "$work/clang" "$out/clang.tar.xz"

for name in plyfile tyro docstring_parser typeguard typing_extensions; do unpack "$name" "$work/libraries"; done
pack "$work/libraries" "$out/libraries.tar.xz"

unpack gsplat "$work/gsplat"
pack "$work/gsplat" "$out/gsplat.tar.xz"

mkdir -p "$work/here"
git -C "$root" archive --prefix=project/ HEAD ':!docs/images' | tar x -C "$work/here"
pack "$work/here" "$out/project.tar.xz"
ls -l "$out"
