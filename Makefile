.PHONY: format lint type test check docs examples wheel test-lowest

format:
	ruff check --select I --fix .
	ruff format .

lint:
	ruff check .
	ruff format --check .

type:
	mypy

test:
	python -m pytest

check: lint type test

# Executes the lesson's pages whose code has changed; SPHINXOPTS="-D nb_execution_mode=off" executes none
docs:
	python -m sphinx -W --keep-going -q -d docs/_build/doctrees $(SPHINXOPTS) docs docs/_build/html
	python docs/_ext/check_html.py docs/_build/html
	python -m sphinx -W --keep-going -q -d docs/_build/doctrees $(SPHINXOPTS) -b doctest docs docs/_build/doctest

# Two at a time; each asserts the numbers that it states
examples:
	ls examples/*.py | xargs -t -n 1 -P 2 env MPLBACKEND=agg python

wheel:
	.ci/wheel

# The oldest versions that pyproject.toml allows; matplotlib 3.8 warns of what pyparsing has deprecated since
test-lowest:
	uv venv --clear build/lowest
	uv pip install --python build/lowest --resolution lowest-direct -e ".[tests]"
	build/lowest/bin/python -m pytest -o filterwarnings=default
