"""Lines of MATLAB that save a variable in a way that can be read."""


def cure(name: str, kind: str, file: str) -> str:
    """Return a sentence with the line.

    Args:
        name: of the variable, with the fields that lead to it.
        kind: what it is, e.g. `a cell` or `a MATLAB object (timeseries)`.
        file: name of the file.
    """
    variable = name.partition(".")[0]
    plain = name.replace(".", "_")
    saved = f"save('{file}', '{variable}', '-append')"
    lines = {
        "a cell": f"{name} = cell2mat({name}); {saved}",
        "a sparse matrix": f"{name} = full({name}); {saved}",
        "complex": f"{name} = [real({name}(:)) imag({name}(:))]; {saved}",
        "a function": f"clear {variable}",
        "empty": f"clear {variable}",
        "a MATLAB object (timeseries)": f"{plain} = struct('t', {name}.Time, 'x', {name}.Data); {_new(file, plain)}",
        "a MATLAB object (table)": f"{plain} = table2struct({name}, 'ToScalar', true); {_new(file, plain)}",
        "a MATLAB object (timetable)": (
            f"T = timetable2table({name}); T.(1) = seconds(T.(1) - T{{1,1}}); {plain} = table2struct(T, 'ToScalar', true); "
            f"{_new(file, plain)}"
        ),
        "a MATLAB object (datetime)": f"{name} = seconds({name} - {name}(1)); {saved}",
        "a MATLAB object (duration)": f"{name} = seconds({name}); {saved}",
        "a MATLAB object (string)": f"{name} = cellstr({name}); {saved}",
        "a MATLAB object (categorical)": f"{name} = cellstr({name}); {saved}",
    }
    if kind in lines:
        line = lines[kind]
    elif kind.startswith("a struct array"):
        line = f"{name} = table2struct(struct2table({name}), 'ToScalar', true); {saved}"
    elif kind.startswith("a MATLAB object"):
        line = f"{plain} = struct('t', <times>, 'x', <numbers of {name}>); {_new(file, plain)}"
    else:
        line = f"x = <one number per sample of {name}>; save('{file}', 'x', '-append')"
    return f"In MATLAB: {line}"


def _new(file: str, variable: str) -> str:
    return f"save('{file}', '{variable}', '-append')"
