# Each command makes what it needs: see container/run.
run = ./container/run

# A rank that fails can leave the others waiting; no run goes without an end.
limit = timeout --kill-after=20 2400

readers = env TOOLS=readers.txt container/tool pytest -p meshio -p vtk -p pyvista -p nbclient

.PHONY: demo studies verify fuzz endurance docs quick quick-half quick-others test test-alone test-first \
    test-pair quick-pair coverage mutants ranks ranks-3 ranks-4 readers browser test-package test-wheels lint types clean purge

demo:
	$(run) $(limit) mpirun -n 2 python3 demos/demo_s1.py

# docs/studies.md with all its tables and pictures, and the film of docs/tutorial.md
studies:
	$(run) timeout --kill-after=20 3600 mpirun -n 2 python3 demos docs
	$(run) $(limit) mpirun -n 2 python3 demos/film.py docs

# docs/verification.md: what the program claims, checked by other code; then the same on two ranks
groups := forces offset random bounds sharpness thin terms quantities
verification = timeout --kill-after=20 7200
verify:
	for group in $(groups); do \
	    $(run) $(verification) python3 verification --only $$group --out docs/verification.md || failed=1; \
	    $(run) $(verification) mpirun -n 2 python3 verification --only $$group || failed=1; \
	done; [ -z "$$failed" ]

# What the tests draw a few of, in numbers; every seed that fails is to become a test.
fuzz:
	$(run) python3 tests/test_fuzz.py --expressions 100000 --ufl 20000 --towers 2000 --files 20000 --problems 3000
	$(run) python3 tests/mesh_mutations.py --count 5000

# A thousand solves, refinements, certificates and pictures in one process: does memory grow?
endurance:
	$(run) python3 tests/endurance.py

# The site, from docs/ and the docstrings: docs/_build/index.html
docs:
	$(run) container/tool sphinx -W --keep-going -q -b html docs docs/_build

# While one works: lint and types, beside them the tests that take next to no time, half of them in
# some streets
half := tests/estimate tests/verification tests/vi
quick:
	@$(MAKE) --no-print-directory --keep-going --jobs --output-sync=target \
	    lint types quick-half quick-others

quick-half:
	$(run) $(limit) python3 -m pytest -q -m 'not slow' $(half)

quick-others:
	$(run) $(limit) python3 -m pytest -q -m 'not slow' $(half:%=--ignore=%)

test: test-alone test-pair

test-alone:
	$(run) $(limit) python3 -m pytest

# Each test, but slow ones with the first of their parameters alone
test-first:
	$(run) $(limit) python3 -m pytest --first

test-pair:
	$(run) $(limit) mpirun -n 2 python3 -m pytest

# Of those of test-first what takes next to no time, or depends on how a mesh is shared out
quick-pair:
	$(run) $(limit) mpirun -n 2 python3 -m pytest --first -m 'ranks or not slow'

# Branches of signorini_cr/ that no test takes, on one rank and on two together
coverage:
	$(run) container/tool coverage erase
	$(run) $(limit) container/tool coverage run -m pytest -q
	$(run) $(limit) mpirun -n 2 container/tool coverage run -m pytest -q
	$(run) container/tool coverage combine -q
	$(run) container/tool coverage report

# Mistakes put into the program, one at a time: do the tests notice?
mutants:
	$(run) python3 tests/mutants.py estimate --count 200
	$(run) python3 tests/mutants.py vi --count 100
	$(run) python3 tests/mutants.py multigrid --count 100

# What depends on how a mesh is shared out, on more ranks than that; slow tests with the first of
# their parameters alone where FIRST=--first
ranks: ranks-3 ranks-4

ranks-3 ranks-4: ranks-%:
	$(run) $(limit) mpirun -n $* python3 -m pytest $(FIRST) -m ranks -k 'not rates'

# What is left for others, read by others: meshio, VTK, PyVista, Jupyter; -p fails without one.
readers:
	$(run) $(limit) $(readers) tests/output/test_vtu.py tests/output/test_notebook.py
	$(run) $(limit) mpirun -n 2 $(readers) tests/output/test_vtu.py

# The pages of runs at the width of a phone and of a desk, in a browser
browser:
	./container/check-browser

# sdist and wheel, built, installed and tried: on the DOLFINx that is there, and on that of pip
test-package:
	./container/check-package

test-wheels:
	./container/check-package wheels

# All of it is told at once, whatever fails first.
lint:
	@failed=; \
	$(run) container/tool ruff check || failed=1; \
	$(run) container/tool ruff format --check || failed=1; \
	$(run) container/tool pytest -q tests/test_metadata.py || failed=1; \
	if command -v shellcheck >/dev/null; then \
	    grep -lr '^#!.*sh$$' container .ci | xargs -d '\n' shellcheck || failed=1; \
	else echo 'no shellcheck here: the shell scripts are not looked at'; fi; \
	[ -z "$$failed" ]

types:
	$(run) container/tool mypy

# What tools leave behind, but no results, and nothing of the user's own.
clean:
	git clean -fdX -e '!/out/' -e '!/demo-output/' -e '!/*-out/' \
	    -e '!/results/' -e '!/membrane.toml' -e '!/signorini/'

# The environments, those of other checkouts with them.
purge:
	rm -rf --one-file-system "$${XDG_CACHE_HOME:-$$HOME/.cache}"/signorini_cr \
	    "$${XDG_CACHE_HOME:-$$HOME/.cache}"/signorini_cr-tools-*
