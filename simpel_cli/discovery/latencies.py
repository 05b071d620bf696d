"""How late each reading is, where the data give that by a range."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from simpel_cli.data import read
from simpel_cli.discovery.ground import counted
from simpel_cli.discovery.latency import Latency, estimated, in_words, same_readings
from simpel_cli.discovery.search.settings import Discovery
from simpel_cli.discovery.search.smaller import carried, small_search
from simpel_cli.discovery.search.trials import Trial
from simpel_cli.filtering.measurements.cleaning import without_computed
from simpel_cli.filtering.setup import Setup, setup
from simpel_cli.runs.console import Terminal
from simpel_cli.studies.declared import Declared
from simpel_cli.studies.open import Study
from simulators.model import Model


def latencies_of(study: Study, data_folder: Path, terminal: Terminal) -> dict[str, Latency]:
    """Estimate the latencies that the data give by a range, with the simulator as it is."""
    model, measurements = study.system.source, study.measurements
    ranges = measurements.latency_ranges()
    if not ranges:
        return {}
    assert isinstance(model, Model)
    options: Discovery = study.declared.groups.get("discovery") or Discovery()
    names = [*(q.name for q in model.states), *study.recording.outputs]
    columns = {name: names.index(name) for name in ranges}
    longest = {name: high for name, (_, high) in ranges.items()}
    known: list[tuple[Setup, Trial]] = []  # the best calibration so far: another latency moves it little

    def evidence(at: Mapping[str, float]) -> float:
        own = replace(measurements, latency=dict(measurements.latency) | dict(at))
        recording = without_computed(read(own, model, data_folder, 0, whole=False), model)
        recording = counted(same_readings(recording, columns, at, longest, model.dt), study)
        plan = setup(model, recording, tuple(own.noise_std), [], options.substeps, most_rows=options.rows)
        optimum = carried(known[-1][0], known[-1][1].optimum.z, plan) if known else None
        base = small_search(plan._replace(optimum=optimum), options.lanes, 1).base()
        if not known or base.optimum.log_evidence > known[-1][1].optimum.log_evidence:
            known.append((plan, base))
        return float(base.optimum.log_evidence)

    found = estimated(evidence, ranges, model.dt)
    terminal.line(in_words(found), "latency")
    return found


def with_latencies(declared: Declared, found: dict[str, Latency]) -> Declared:
    """Return the configuration whose data say how late each reading is, so that whatever follows takes it so."""
    data = declared.config["data"]
    said = {name: round(each.value, 12) for name, each in found.items()}
    return declared.changed(data=data | {"latency": dict(data.get("latency") or {}) | said})
