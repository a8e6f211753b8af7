# Everything runs in .venv, which is made (or brought up to date) on the first call. Needs python3 >= 3.11 with venv and pip,
# and a C++17 compiler.
PYTHON ?= python3
BIN := .venv/bin
INSTALL := $(BIN)/python -m pip install --quiet --no-compile -c constraints.txt
# Tests run in a process for each processor; those of a file stay together, since they share what is dear to make.
# tests/conftest.py puts the slow files first; xdist's own order, most tests first, would leave them to the end.
SPREAD := -n auto --dist loadfile --no-loadscope-reorder
# What pytest does to show the values of a failed assert takes each process longer than the rest of collecting: a file that
# fails shows them where it runs alone.
QUICK := $(SPREAD) --assert=plain
# Programs that tests start would else compile all that they import.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test types units torch vtk clang docs site heavy pictures notebooks hard every results device lib paraview compile-times lowest newest wheels \
	wasm view clean

# Simulate a small series, encode it, decode it, compare and draw: demo/vortex.h5, .fhz and .png. Installs the plain package.
demo: .venv/.plain
	$(BIN)/fhash demo -o demo --force

# All that needs none of the heavy tools below. Types are checked beside the tests.
test: .venv/.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(MAKE) --no-print-directory -j 2 types units

types: .venv/.stamp
	$(BIN)/mypy

units: .venv/.stamp
	$(BIN)/python -m pytest $(QUICK)

# Tests that need one heavy tool, which is installed here and not by `make test`: torch; VTK; Clang as the package ziglang.
torch vtk clang: %: .venv/.%
	$(BIN)/python -m pytest $(QUICK) -m '$@ and not every'

# The documentation site: build/docs/index.html. Needs no network; a warning is an error. All that its pages show runs; its
# reference imports modules that need torch.
docs: site
	$(BIN)/python -m pytest $(SPREAD) -m docs

site: .venv/.docs .venv/.torch .venv/.vtk
	rm -rf build/docs
	$(BIN)/sphinx-build -q -W --keep-going -b html docs build/docs

# The tests of docs and vtk in one run, which collects once.
heavy: .venv/.docs .venv/.torch .venv/.vtk
	$(BIN)/python -m pytest $(QUICK) -m '(docs or vtk) and not every'

# The pictures of the pages anew, from a file of real data: make pictures DATA=isabel.h5 (the tables: make results).
pictures: .venv/.stamp
	$(BIN)/python docs/make_pictures.py $(DATA)

# The notebooks of the documentation with their outputs.
notebooks: .venv/.docs
	cd docs/notebooks && $(CURDIR)/$(BIN)/jupyter execute --inplace *.ipynb && rm -f *.nc *.fhz

# Hard cases, hostile files, faults, fuzzing and `fhash selftest --all`: an hour on 2 processors; needs g++. docs/stability.md
# gets the figures.
hard: .venv/.torch .venv/.clang
	mkdir -p build/hard
	rm -f build/hard/figures.jsonl
	FHASH_HARD=1 FHASH_HARD_REPORT=build/hard/figures.jsonl $(BIN)/python -m pytest $(SPREAD) -m "" tests/fresh tests/golden tests/hard
	FHASH_HARD_REPORT=build/hard/figures.jsonl $(BIN)/python tests/hard/fuzz/run.py --march --seconds 600 --crashes build/hard/crashes
	FHASH_HARD_REPORT=build/hard/figures.jsonl $(BIN)/python tests/hard/fuzz/readers.py --seconds 600 --keep build/hard/sources
	$(BIN)/fhash selftest --all --report build/hard/stability.md --force
	$(BIN)/python tests/hard/summary.py build/hard/stability.md build/hard/figures.jsonl docs/stability.md

# Every case of every other test, whatever its mark.
every: .venv/.torch .venv/.vtk
	FHASH_HARD=1 $(BIN)/python -m pytest $(SPREAD) -m "" --ignore tests/fresh --ignore tests/golden --ignore tests/hard

# Whether the versions that pyproject.toml tells are true: the lowest of each library that it names, or the newest of
# everything, each in an environment of its own below build/; quick tests of what these libraries do. torch is left out, since
# it takes gigabytes, and so is what draws the documentation. Tools of the tests are the newest in both: users install
# none, and what was told of the libraries before holds them where they are. The installation is editable, since tests start
# programs in the root, where Python would find the sources first.
lowest: RESOLUTION := lowest-direct
newest: RESOLUTION := highest
ENDS_EXTRAS := formats,segy,grib,adios,mesh,video,remote,notebook,bench
ENDS_TOOLS := pytest hypothesis jsonschema cftime nibabel mrcfile pynrrd obstore dask
ENDS_TESTS := tests/cli tests/formats/container tests/formats/readers tests/formats/writers tests/formats/transform/test_values.py \
	tests/codec/test_dataset.py tests/codec/test_encoding.py tests/codec/test_pictures.py tests/codec/test_plain.py \
	tests/codec/test_volume.py tests/codec/test_xarray_backend.py tests/codec/views/test_pack.py tests/codec/rendering/test_renderer.py
lowest newest:
	rm -rf build/$@
	$(PYTHON) -m venv build/$@
	build/$@/bin/python -m pip install --quiet uv
	build/$@/bin/python -m uv pip install --quiet --resolution $(RESOLUTION) -e '.[$(ENDS_EXTRAS)]' -e ./benchmarks
	build/$@/bin/python -m uv pip freeze --exclude-editable > build/$@/told.txt
	build/$@/bin/python -m uv pip install --quiet -c build/$@/told.txt $(ENDS_TOOLS)
	build/$@/bin/python -m uv pip list
	build/$@/bin/pytest $(ENDS_TESTS)

# Figures of README.md and docs/ from benchmarks/results, which hold what `fhash bench ... --json` printed: quick.
results: .venv/.stamp
	$(BIN)/python -m fhash_bench.results

# libfhash, shared and static, its header, fhash.pc and CMake's files below build/lib (docs/howto/c-library.md). Needs cmake.
lib:
	cmake -S formats/fhash_formats/native -B build/cmake -DCMAKE_INSTALL_PREFIX=$(CURDIR)/build/lib -DCMAKE_INSTALL_LIBDIR=lib
	cmake --build build/cmake --parallel 2
	cmake --install build/cmake

# What pvpython shows of a container, and its picture in build/paraview. Needs paraview, python3-paraview and xvfb.
paraview: .venv/.vtk
	FHASH_PARAVIEW=$(CURDIR)/build/paraview $(BIN)/python -m pytest -rs -m "" tests/codec/views/test_vtk.py

# Figures of a GPU in build/device, by the python3 that has its torch, without network (docs/howto/gpu.md): 8 minutes.
device:
	$(PYTHON) setup.py -q build_ext --inplace
	$(PYTHON) tests/device/run.py build/device

# A source archive and a wheel for every Python 3 of each platform in dist/, by the compiler of ziglang, and that of the
# benchmarks: ten minutes on 2 processors.
PLATFORMS := x86_64-linux-gnu.2.17/manylinux_2_17_x86_64 aarch64-linux-gnu.2.17/manylinux_2_17_aarch64 \
	x86_64-linux-musl/musllinux_1_2_x86_64 aarch64-linux-musl/musllinux_1_2_aarch64 x86_64-macos.11.0/macosx_11_0_x86_64 \
	aarch64-macos.11.0/macosx_11_0_arm64 x86_64-windows-gnu/win_amd64 aarch64-windows-gnu/win_arm64
wheels: .venv/.clang $(PLATFORMS:%=wheel/%)
	$(BIN)/python -m build --no-isolation --sdist --outdir dist
	$(BIN)/python -m build --no-isolation --wheel --outdir dist benchmarks
	ls -l dist

# CPU seconds of each unit that the compiler takes, one after the other; tests hold the sizes of objects.
compile-times: .venv/.plain
	$(BIN)/python setup.py -q compile_times

# The decoder in the page of `fhash view`, which is committed: fhash_codec/views/page/fhash.wasm. Debian: clang-14, lld-14, wasi-libc,
# libc++-14-dev-wasm32, libc++abi-14-dev-wasm32, libclang-rt-14-dev-wasm32.
wasm: .venv/.stamp
	$(BIN)/python setup.py -q wasm

# The page of `fhash view` in Chromium with larger files, and its figures: build/view.
view: .venv/.stamp
	FHASH_VIEW=build/view $(BIN)/python -m pytest tests/codec/views/test_page.py

wheel/%: .venv/.clang
	FHASH_TARGET=$(*D) $(BIN)/python setup.py -q build --build-base build/$(*F) bdist_wheel --plat-name $(*F) -d dist

# Python compiles what it imports; pip would compile all, which takes minutes.
.venv/.stamp: pyproject.toml benchmarks/pyproject.toml constraints.txt | .venv/bin/python
	$(INSTALL) -e '.[dev]' -e ./benchmarks
	touch $@ .venv/.plain

# Heavy tools, each by what brings it in beside what is there.
PACKAGES_torch := 'fhash[cuda,torch]'
PACKAGES_vtk := 'fhash-bench[vtk]'
PACKAGES_docs := 'fhash[docs]'
PACKAGES_clang := ziglang build
.venv/.%: constraints.txt | .venv/.stamp
	$(INSTALL) $(PACKAGES_$*)
	touch $@

.venv/.plain: pyproject.toml constraints.txt | .venv/bin/python
	$(INSTALL) -e .
	touch $@

.venv/bin/python:
	$(PYTHON) -c 'import sys; sys.exit("fhash needs Python 3.11 or newer" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv .venv

clean:
	rm -rf .venv build dist demo *.egg-info benchmarks/*.egg-info benchmarks/build .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
