.PHONY: format lint type test check tables docs examples agents wheel test-lowest

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

# Writes the tables of results into README.md and docs/, from the rows
tables:
	python docs/_ext/fill_tables.py

# Executes the tutorial's pages whose code has changed; SPHINXOPTS="-D nb_execution_mode=off" executes none
docs:
	python -m sphinx -W --keep-going -q -d docs/_build/doctrees $(SPHINXOPTS) docs docs/_build/html
	python docs/_ext/check_html.py docs/_build/html
	python -m sphinx -W --keep-going -q -d docs/_build/doctrees $(SPHINXOPTS) -b doctest docs docs/_build/doctest

# Each example asserts the numbers that it states
examples:
	MPLBACKEND=agg python .ci/in_turn.py examples/*.py

# Agents for five tasks, with a model card each: python -m sb3_reinforce.zoo enjoy --algo reinforce --env Pendulum-v1 -f agents
TASKS = MountainCar-v0:300000 Pendulum-v1:100000 Acrobot-v1:100000 MountainCarContinuous-v0:20000 CartPole-v1:50000
agents:
	printf '%s\n' $(TASKS) | xargs -P 2 -I {} env OMP_NUM_THREADS=1 sh -c 'task={}; \
	python -m sb3_reinforce.zoo train --algo reinforce --env $${task%:*} -n $${task#*:} -f agents --eval-freq -1 --seed 0 && \
	python -m sb3_reinforce.zoo.model_card --algo reinforce --env $${task%:*} -f agents'

wheel:
	.ci/wheel $(WHEEL_OPTIONS)

# The oldest versions that pyproject.toml allows; matplotlib 3.8 warns of what pyparsing has deprecated since
test-lowest:
	uv venv --clear --python 3.10 build/lowest
	uv pip install --python build/lowest --resolution lowest-direct -e ".[tests]"
	build/lowest/bin/python -m pytest -o filterwarnings=default
