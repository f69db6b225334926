"""``certbound simulate``: one JSON object, reproducible counts, and every malformed input refused with exit code 2."""

import json

import pytest

import certbound as cb
from certbound.cli.app import run
from certbound.safety.certificate import problem_data

KEYS = {
    "paths", "exits", "probability", "lower", "upper", "confidence", "path_steps_per_second", "seconds", "step",
    "refuted",
}  # fmt: skip


def answer(capsys, *words, code=0):
    """The JSON object that a command printed."""
    assert run(["simulate", *words, "--json"]) == code
    return json.loads(capsys.readouterr().out)


def refusal(capsys, *words):
    """The message of a refused command, which printed nothing else."""
    assert run(["simulate", *words]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert len(printed.err.splitlines()) == 3
    return printed.err


def test_the_json_object_has_the_keys_of_the_contract(capsys):
    found = answer(capsys, "ou", "--paths", "2e3", "--seed", "1", "--set", "radius=0.8")
    assert set(found) >= KEYS
    assert found["paths"] == 2000
    assert found["lower"] <= found["probability"] == found["exits"] / 2000 <= found["upper"]
    assert found["confidence"] == 0.99
    assert found["steps"] == 1000


def test_a_seed_gives_the_same_counts_and_another_gives_others(capsys):
    words = ("ou", "--paths", "5000", "--set", "radius=0.6", "--step", "0.05")
    first, second, other = (answer(capsys, *words, "--seed", seed)["exits"] for seed in ("1", "1", "2"))
    assert first == second != other
    assert answer(capsys, *words)["paths"] == 5000


def test_a_step_is_a_number_of_steps(capsys):
    assert answer(capsys, "ou", "--paths", "10", "--step", "0.3")["steps"] == 17
    assert answer(capsys, "ou", "--paths", "10", "--step", "0.005")["steps"] == 1000
    assert answer(capsys, "ou", "--paths", "10", "--horizon", "2", "--step", "0.1")["steps"] == 20


def test_rare_exits_come_with_a_standard_error(capsys):
    found = answer(capsys, "ou", "--paths", "5e3", "--seed", "1", "--rare", "--step", "0.05")
    assert set(found) >= KEYS | {"standard_error"}
    assert 0 < found["standard_error"] < found["probability"] < 1e-3


def test_text_for_people_tells_what_is_refuted(capsys):
    assert run(["simulate", "ou", "--paths", "2000", "--seed", "1", "--set", "radius=0.8"]) == 0
    text = capsys.readouterr().out
    assert "exit probability" in text
    assert "(99 % sampling [0." in text
    assert "]; the step adds about " in text
    assert "of 2000 paths left, 1000 steps of the exact scheme" in text
    assert "it refutes every bound below 0." in text
    assert ", and supports none below 0." in text


def test_what_only_one_step_refutes_is_not_refuted(capsys, monkeypatch):
    from certbound.simulation.estimates import montecarlo

    def coarse_alone(counts, exits, pairs, confidence, known=montecarlo.step_effect):
        return known([0, pairs // 10, 0], (exits[0] // 100, exits[1]), pairs, confidence)

    monkeypatch.setattr(montecarlo, "step_effect", coarse_alone)
    words = ("ou", "--paths", "2000", "--seed", "1", "--set", "radius=0.8")
    found = answer(capsys, *words)
    assert found["lower"] > 0.0 == found["refuted"]
    assert found["step"]["adds"] == 0.1
    assert run(["simulate", *words]) == 0
    assert "it refutes no bound, as half of the step does not, and supports" in capsys.readouterr().out


def test_discrete_time_has_no_step(capsys):
    assert answer(capsys, "chain", "--paths", "100", "--seed", "1")["step"] is None
    assert run(["simulate", "chain", "--paths", "100", "--seed", "1"]) == 0
    assert "the step adds" not in capsys.readouterr().out


def test_without_an_exit_no_bound_is_refuted(capsys):
    assert run(["simulate", "ou", "--paths", "1000", "--seed", "1"]) == 0
    assert "it refutes no bound, and supports none below 0.005" in capsys.readouterr().out


def claimed(path, level, **changes):
    """A file that claims 10^level of ou with radius 0.8."""
    problem = problem_data(cb.load("ou", radius=0.8).replace(**changes))
    path.write_text(json.dumps({"claim": {"log10_delta": float(level).hex()}, "problem": problem}))


@pytest.mark.parametrize(("claim", "code"), [(-1, 1), (-0.5, 0)])
def test_a_certificate_is_contradicted_or_not(tmp_path, capsys, claim, code):
    path = tmp_path / "cert.json"
    claimed(path, claim, delta=1e-9, name="of another name")  # neither counts
    words = ("ou", "--paths", "5000", "--seed", "1", "--set", "radius=0.8", "--against", str(path))
    found = answer(capsys, *words, code=code)
    assert found["against"]["contradicted"] is bool(code)
    assert run(["simulate", *words]) == code
    word = "the simulation contradicts" if code else "does not contradict"
    assert word in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "place"),
    [(("--set", "radius=0.9"), "constraints[0]"), (("--set", "radius=0.8", "--horizon", "6"), "horizon")],
)
def test_a_certificate_of_another_problem_is_refused(tmp_path, capsys, words, place):
    path = tmp_path / "cert.json"
    claimed(path, -1)
    said = refusal(capsys, "ou", "--paths", "10", "--against", str(path), *words)
    assert "speaks of another problem than the one to be simulated" in said
    assert place in said


@pytest.mark.parametrize(
    "content",
    ["", "[]", "{}", '{"log10_delta": 3}', '{"claim": {"log10_delta": "-0x1p+0"}}', '{"claim": 3}', "[" * 100_000,
     '{"claim": {"log10_delta": "-0x1p+0"}, "problem": 3}'],
)  # fmt: skip
def test_a_file_that_is_no_certificate_is_refused(tmp_path, capsys, content):
    path = tmp_path / "cert.json"
    path.write_text(content)
    assert "certbound: " in refusal(capsys, "ou", "--paths", "10", "--against", str(path))


@pytest.mark.parametrize("level", ["nan", "0x1p+0", "x", 3])
def test_a_claim_that_is_no_probability_is_refused(tmp_path, capsys, level):
    path = tmp_path / "cert.json"
    path.write_text(json.dumps({"claim": {"log10_delta": level}, "problem": problem_data(cb.load("ou"))}))
    assert "verify --certificate" in refusal(capsys, "ou", "--paths", "10", "--against", str(path))


def test_a_checkpoint_is_continued_with_its_own_seed(tmp_path, capsys):
    words = ("ou", "--paths", "3000", "--set", "radius=0.8", "--checkpoint", str(tmp_path / "run.npz"))
    assert answer(capsys, *words)["exits"] == answer(capsys, *words)["exits"]
    assert "belongs to another seed" in refusal(capsys, *words, "--seed", "77")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("ou", "--paths", "0"), "`paths` must be a positive whole number"),
        (("ou", "--paths", "-5"), "`paths` must be a positive whole number"),
        (("ou", "--paths", "1.5"), "must be a whole number"),
        (("ou", "--paths", "nan"), "must be a finite number"),
        (("ou", "--paths", "10", "--seed", "-1"), "`--seed` must not be negative"),
        (("ou", "--paths", "10", "--step", "0"), "`--step` must lie in (0, 5]"),
        (("ou", "--paths", "10", "--step", "9"), "`--step` must lie in (0, 5]"),
        (("ou", "--paths", "10", "--step", "1e-12"), "`steps` must be at most"),
        (("chain", "--paths", "10", "--step", "1"), "`--step` has no meaning in discrete time"),
        (("ou", "--paths", "10", "--confidence", "1"), "`confidence` must lie in (0, 1)"),
        (("ou", "--paths", "10", "--set", "speed=1"), "speed"),
        (("no_such_problem", "--paths", "10"), "no_such_problem"),
        (("ou", "--paths", "10", "--checkpoint", "/nowhere/at/all"), "does not exist"),
        (("ou", "--paths", "10", "--against", "/nowhere/at/all"), "No such file"),
    ],
)
def test_malformed_input_is_refused(capsys, words, message):
    assert message in refusal(capsys, *words)


def test_a_scheduler_that_is_not_there_is_refused(capsys, monkeypatch):
    pytest.importorskip("distributed", reason="needs the extra `cluster` (dask[distributed])")
    from certbound import parallel

    monkeypatch.setattr(parallel.connect, "__defaults__", (0.5,))
    message = refusal(capsys, "ou", "--paths", "10", "--cluster", "tcp://127.0.0.1:9")
    assert "must be the address of a running dask scheduler" in message
