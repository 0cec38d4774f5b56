.PHONY: format lint type test check

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
