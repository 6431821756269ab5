# make demo   the whole service against a simulated machine, live in the terminal
# make venv   daqsvc itself, as .venv/bin/daqsvc; . .venv/bin/activate puts it on the PATH of a shell
# make test   the tests; make test ROOM=rotor those of one room, a folder of tests/
# make test-long  the long ones: statistics over hundreds of runs, soak, fuzz; make test-long ROOM=rotor those of one room
# make hil    tests on real CAN interfaces (vcan), and of the unit under systemd, in a guest kernel; as root
# make check  formatting, lint, types, layers, spelling and plain English
# make bench  speed, as ratios measured in one run
# make dist   what a release consists of, in dist/: wheel, and a CycloneDX list of everything it is installed with
# make guard  is what users see as before? make guard ARGS=--take updates the golden texts
# make measure  figures of the source: lines, circles of imports, names that occur twice
# make nothing-lost  200 randomised runs with kills, outages and full disks: does every alarm arrive?
# make soak  ten minutes of all that can happen to several machines; make soak SECONDS=86400 a day of it
# make bench-diagnosis  names given to machines that nobody modelled (finite elements), into docs/plants.md
# make bench-data  the tables of the documentation, again from the measured recordings
# make docs   the site of the documentation, in build/docs/html; fails if a link leads nowhere
# make pictures  docs/pictures, again from the product; make pictures ARGS=timebase one of them
# make evaluation  the tables of docs/evaluate.md, again from the figures on the other pages
# make deb    a Debian package of the service, in dist/; apt install ./dist/daqsvc_*.deb
# make test-wheel  the everyday tests against the wheel in dist/, installed in a separate venv
# make hooks  have git check every commit
# make reference  the pages of docs/reference, again from the code, and the schemas of docs/schemas
# make proto  the module of the Sparkplug payload, again from its schema
# Each sets up what it needs in .venv; nothing else on the machine is touched.

PYTHON ?= python3.11
# Tests run side by side, in two processes more than there are cores, as tests of services wait for most of their
# time. Each process begins at its end of the list, until one helps the other.
WORKERS ?= $(shell expr $$(nproc) + 2)
# Without ROOM all of them.
ROOMS = $(sort $(patsubst tests/%/,%,$(dir $(wildcard tests/*/test_*.py tests/*/*/test_*.py))))
TESTS = $(if $(ROOM),$(if $(filter $(ROOMS),$(ROOM)),tests/$(ROOM),$(error there is no room '$(ROOM)' in tests/; there are $(ROOMS))))
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
# Compiled kernels are kept here, so that only the first run compiles them.
# Small linear systems only: threads of the linear algebra library cost more than they save.
# Python keeps what it has compiled, else each process that a test starts compiles it again.
unexport PYTHONDONTWRITEBYTECODE
export OMP_NUM_THREADS ?= 1
export NUMBA_CACHE_DIR ?= $(CURDIR)/.cache/kernels

.DEFAULT_GOAL := help
.PHONY: help demo venv test test-long hil check guard measure bench bench-data bench-diagnosis docs reference evaluation pictures dist deb nothing-lost soak test-wheel hooks proto lock clean

help:
	@sed -n 's/^# \(make.*\)/\1/p' Makefile

$(READY): requirements-dev.lock pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "make: $(PYTHON) is missing; install it with: apt-get install python3.11 python3.11-venv"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo "make: the venv module of $(PYTHON) is missing; install it with: apt-get install python3.11-venv"; exit 1; }
	@echo "setting up $(VENV) (first time only) ..."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-dev.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

demo: $(READY)
	@$(BIN)/daqsvc demo --snapshots build/demo --page $(ARGS)

venv: $(READY)

test: $(READY)
	@$(BIN)/python -m pytest --numprocesses $(WORKERS) --dist worksteal -m "not long" $(TESTS) $(ARGS)

# Property tests are tried with all their examples here, with a third of them in `make test`.
test-long: $(READY)
	@DAQSVC_EXAMPLES=all $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist worksteal -m "long or hypothesis" $(TESTS) $(ARGS)

hil: $(READY)
	@tests/hil/run.sh $(ARGS)

check: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports
	@$(BIN)/codespell
	@PYTHONPATH=tests $(BIN)/python -m prose
	@$(BIN)/proselint check --config tests/prose/proselint.json README.md CONTRIBUTING.md \
		docs/*.md docs/tutorials/*.md docs/reference/*.md docs/decisions/*.md

bench: $(READY)
	@missed=; for bench in tests/bench/bench_*.py; do PYTHONPATH=$(CURDIR):tests $(BIN)/python $$bench || missed="$$missed $$bench"; done; \
	if [ -n "$$missed" ]; then echo "make: targets were missed by$$missed"; exit 1; fi

# In a separate environment: nothing of it is part of the service. The network is only needed to set that up.
DOCS := build/docs/html
DOCS_VENV := .venv-docs
$(DOCS_VENV)/.ready: requirements-docs.lock
	@$(PYTHON) -m venv $(DOCS_VENV)
	@$(DOCS_VENV)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --no-deps -r requirements-docs.lock
	@touch $@

docs: $(DOCS_VENV)/.ready
	@rm -rf $(DOCS)
	@$(DOCS_VENV)/bin/python -m sphinx --builder html --fail-on-warning --keep-going --nitpicky --quiet --fresh-env \
		--doctree-dir build/docs/doctrees docs $(DOCS)
	@echo "the documentation is in $(DOCS)/index.html"

# Built with what requirements-dev.lock pins: nothing is fetched meanwhile. Times are those of the commit, so that
# the same commit makes the same wheel.
DIST := dist
dist: $(READY)
	@rm -rf $(DIST) && mkdir -p $(DIST)
	@SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct 2>/dev/null || echo 315532800) \
		$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-index --no-deps --no-build-isolation --wheel-dir $(DIST) .
	@$(BIN)/python -m cyclonedx_py requirements requirements.lock --pyproject pyproject.toml --output-reproducible \
		--output-file $$(ls $(DIST)/*.whl | sed 's/-py3.*//').cdx.json
	@ls $(DIST)

# What the service needs and no more. Between two releases the number of commits makes each package newer than the last.
DEB := $(DIST)/deb
deb: dist docs
	@command -v dh >/dev/null || { echo "make: debhelper is missing; install it with: apt-get install debhelper"; exit 1; }
	@test -x /usr/bin/python3.11 || { echo "make: Debian's own Python is missing; install it with: apt-get install python3.11"; exit 1; }
	@mkdir -p $(DEB)/source && cp -r packaging/debian requirements-service.lock config docs CHANGELOG.md $(DEB)/source/
	@cp -r $(DOCS) $(DEB)/source/html
	@cp config/systemd/daqsvc@.service config/systemd/daqsvc.sysusers.conf $(DEB)/source/debian/
	@mv $(DEB)/source/debian/daqsvc.sysusers.conf $(DEB)/source/debian/daqsvc.sysusers
	@version=$$($(BIN)/python -c 'import daqsvc; print(daqsvc.__version__)'); \
	commits=$$(git rev-list --count HEAD 2>/dev/null) && ! git describe --exact-match --tags >/dev/null 2>&1 && \
		version=$$version+$$commits.g$$(git rev-parse --short HEAD); \
	printf 'daqsvc (%s) stable; urgency=medium\n\n  * See CHANGELOG.md.\n\n -- daqsvc developers <daqsvc@localhost>  %s\n' \
		"$$version" "$$(git log -1 --format=%cD 2>/dev/null || date -R -d @315532800)" > $(DEB)/source/debian/changelog
	@cd $(DEB)/source && PIP="$(abspath $(BIN))/python -m pip" WHEEL=$$(ls $(abspath $(DIST))/*.whl) \
		env --unset=MAKEFLAGS --unset=MAKEOVERRIDES dpkg-buildpackage --build=binary --no-sign > ../build.log 2>&1 \
		|| { tail -30 ../build.log; echo "make: the package was not built; $(DEB)/build.log has all of it"; exit 1; }
	@mv $(DEB)/daqsvc_*.deb $(DIST)/ && rm -r $(DEB)/source && ls -l $(DIST)/daqsvc_*.deb

# All that is tracked, but for the packages: what is tested is what the wheel has installed.
test-wheel: dist
	@$(PYTHON) -m venv $(DIST)/venv
	@$(DIST)/venv/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements-dev.lock
	@$(DIST)/venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-index $(DIST)/*.whl
	@mkdir $(DIST)/tree && git archive HEAD | tar -x -C $(DIST)/tree --exclude=daqsvc --exclude=drivers --exclude=sim_hw
	@cd $(DIST)/tree && ../venv/bin/python -m pytest --numprocesses $(WORKERS) --dist worksteal -m "not long and not sources" $(ARGS)

hooks: $(READY)
	@$(BIN)/pre-commit install

guard: $(READY)
	@PYTHONPATH=tests $(BIN)/python -m guard $(ARGS)

measure: $(READY)
	@PYTHONPATH=tests $(BIN)/python -m guard.measure

nothing-lost: $(READY)
	@PYTHONPATH=tests $(BIN)/python -m nothing_lost $(ARGS)

SECONDS ?= 600
soak: $(READY)
	@PYTHONPATH=tests $(BIN)/python -m soak --seconds $(SECONDS) $(ARGS)

bench-data: $(READY)
	@for table in tests/bench/data_*.py; do $(BIN)/python $$table || exit 1; done
	@$(BIN)/python docs/make_evaluation.py

pictures: $(READY)
	@PYTHONPATH=docs $(BIN)/python -m make_pictures $(ARGS)

evaluation: $(READY)
	@$(BIN)/python docs/make_evaluation.py

# Rotors by finite elements, in an environment of their own: what makes them is no part of the service. The lock is
# complete; left to itself pip looks for extras that it does not have.
PLANTS := build/plants
PLANTS_VENV := .venv-plants
$(PLANTS_VENV)/.ready: requirements-plants.lock
	@$(PYTHON) -m venv $(PLANTS_VENV)
	@$(PLANTS_VENV)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --no-deps -r requirements-plants.lock
	@touch $@

$(PLANTS)/cases.json: $(PLANTS_VENV)/.ready $(addprefix tests/plants/,machines.py bench.py drawn.py simulate.py records.py)
	@PYTHONPATH=tests $(PLANTS_VENV)/bin/python -m plants.records $(PLANTS)

$(PLANTS)/bank.json: $(PLANTS)/cases.json tests/plants/bank_records.py
	@PYTHONPATH=tests $(PLANTS_VENV)/bin/python -m plants.bank_records $(PLANTS)

bench-diagnosis: $(READY) $(PLANTS)/cases.json $(PLANTS)/bank.json
	@PYTHONPATH=tests $(BIN)/python -m plants.table $(PLANTS) $(ARGS)
	@$(BIN)/python docs/make_evaluation.py

reference: $(READY)
	@$(BIN)/python -m daqsvc.reference docs/reference
	@$(BIN)/python -m daqsvc.publish.schemas docs/schemas
	@$(BIN)/python -m daqsvc.reference.formats docs/schemas

# What is compiled needs a protobuf of this major version, no older than the compiler: it is stated in pyproject.toml.
proto: $(READY)
	@$(BIN)/python -m grpc_tools.protoc -I. --python_out=. --pyi_out=. daqsvc/publish/sparkplug/sparkplug_b.proto daqsvc/snapshots/samples.proto

# Pin again what pyproject.toml asks for. Needs uv (pip install uv).
lock:
	uv pip compile pyproject.toml --all-extras --group dev --universal --generate-hashes --no-emit-index-url --python-version 3.11 --no-header --quiet -o requirements-dev.lock
	uv pip compile pyproject.toml --all-extras --universal --generate-hashes --no-emit-index-url --python-version 3.11 --no-header --quiet -c requirements-dev.lock -o requirements.lock
	uv pip compile pyproject.toml --extra dbc --extra page --universal --generate-hashes --no-emit-index-url --python-version 3.11 --no-header --quiet -c requirements-dev.lock -o requirements-service.lock
	uv pip compile requirements-docs.in --universal --generate-hashes --no-emit-index-url --python-version 3.11 --no-header --quiet -o requirements-docs.lock
	uv pip compile requirements-plants.in --universal --generate-hashes --no-emit-index-url --python-version 3.11 --no-header --quiet -o requirements-plants.lock
	echo 'setuptools>=77' | uv pip compile - --universal --generate-hashes --no-emit-index-url --python-version 3.11 --no-header --quiet -c requirements-dev.lock -o requirements-build.lock

clean:
	rm -rf $(VENV) $(PLANTS_VENV) $(DOCS_VENV) .cache build *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
