"""Run experiments in the tests, and read their results."""

import csv
import json

from vertax.runs import RunFolder, load_config
from vertax.runs._execution import new_folder, write_config


def run(path, output, *overrides):
    experiment, config = load_config(path, overrides)
    folder = RunFolder(new_folder(output, output))
    write_config(folder.path, config)
    folder.save_metrics(experiment.run(config, folder, progress=False))
    return folder.path, json.loads((folder.path / "metrics.json").read_text())


def table(path):
    with open(path, newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0]}
