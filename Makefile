# Footwork's commands. `make help` lists them. Each sets up what it needs in .venv, and
# sets it up again only when pyproject.toml, constraints.txt, the Python or this folder changed.

PYTHON ?= python3
VENV ?= .venv
# Processes that share the tests, and whatever else a command is to be given:
#   make test ARGS="tests/test_ppo.py -k entropy"
WORKERS ?= 2
ARGS ?=

BIN := $(VENV)/bin
STAMP := $(VENV)/.footwork
EXTRAS := dev,tb

.DEFAULT_GOAL := help
.PHONY: help quickstart test bench check format venv venv-dev venv-bench constraints clean

help: ## list the commands
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-12s %s\n", $$1, $$2 }' Makefile

quickstart: venv ## train a master on the maze from packaged sub-policies, and show what it does
	@$(BIN)/footwork quickstart $(ARGS)

test: venv-dev ## run the tests
	@$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal $(ARGS)

bench: ## measure speed beside the physics alone and beside Stable-Baselines3 (ARGS="--quick", "--learning", "--json")
	@$(MAKE) --no-print-directory venv-bench || { echo "make bench: goes on without the extra [bench]" >&2; \
	    $(MAKE) --no-print-directory venv; }
	@$(BIN)/footwork bench $(ARGS)

check: venv-dev ## lint, format, types and the contracts between modules
	@failed=; \
	$(BIN)/ruff check || failed="$$failed lint"; \
	$(BIN)/ruff format --check || failed="$$failed format"; \
	$(BIN)/mypy || failed="$$failed types"; \
	$(BIN)/lint-imports || failed="$$failed contracts"; \
	if [ -n "$$failed" ]; then echo "make check: failed:$$failed" >&2; exit 1; fi; \
	echo "make check: lint, format, types and contracts hold"

format: venv-dev ## let ruff repair what it can
	@$(BIN)/ruff check --fix --exit-zero
	@$(BIN)/ruff format

venv: ## .venv with what running needs
	@$(call setup,run,-e .)

venv-dev: ## .venv with what developing needs
	@$(call setup,dev,-e '.[$(EXTRAS)]')

venv-bench: # whom we are measured beside; brings torch
	@$(call setup,bench,-e '.[bench]')

constraints: ## pin the newest dependencies in constraints.txt (needs uv)
	uv pip compile --quiet --upgrade --universal --python-version 3.11 --fork-strategy fewest \
	    --no-emit-index-url --no-header --no-annotate --all-extras pyproject.toml -o constraints.txt

clean: ## remove .venv and what the tools left behind; runs/ stays
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

# setup(PROFILE, PIP ARGUMENTS): the stamp, written last, holds three lines: the place and the
# Python the environment was made for, what was installed, and the profiles (all others contain "run").
define setup
set -e; \
command -v $(PYTHON) >/dev/null 2>&1 || { echo "Footwork needs Python 3.11 or newer, and found no '$(PYTHON)' (make PYTHON=... names another)." >&2; exit 1; }; \
$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
    { echo "Footwork needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) -V 2>&1) (make PYTHON=... names another)." >&2; exit 1; }; \
place="$$($(PYTHON) -c 'import sys; print(sys.version.split()[0], sys.base_prefix)') $(CURDIR)"; \
wanted=$$({ cat pyproject.toml constraints.txt; echo "$(EXTRAS)"; } | cksum); \
had_place=$$(sed -n 1p $(STAMP) 2>/dev/null || true); \
had=$$(sed -n 2p $(STAMP) 2>/dev/null || true); \
profiles=$$(sed -n 3p $(STAMP) 2>/dev/null || true); \
if [ "$$had_place" != "$$place" ] || ! $(BIN)/python -m pip --version >/dev/null 2>&1; then \
    clear=; if [ -n "$$had_place" ]; then clear=--clear; fi; \
    rm -f $(STAMP); had=; profiles=; \
    $(PYTHON) -m venv $$clear $(VENV) || \
        { echo "Could not make $(VENV): on Debian and Ubuntu, 'apt install python3-venv' brings what is missing." >&2; exit 1; }; \
fi; \
if [ "$$had" != "$$wanted" ]; then profiles=; fi; \
case " $$profiles run " in *" $(1) "*) present=$$profiles;; *) present=;; esac; \
if [ -z "$$present" ]; then \
    echo "Installing into $(VENV) (the first time takes a minute or two) ..."; \
    rm -f $(STAMP); \
    $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt $(2); \
    printf '%s\n%s\n%s\n' "$$place" "$$wanted" "$$profiles $(1)" > $(STAMP); \
fi
endef
