"""Starts that are unions: the worst member decides, its bounds are the problem's, and each has its own proof."""

import numpy as np
import pytest

import certbound as cb
from certbound.checker import check_data, parse
from certbound.cli.commands.check import proved_certificate
from certbound.errors import CertificateError, InfeasibleError
from certbound.problem.files import load, save
from certbound.problem.sets import StartUnion
from certbound.safety.certificate import certificate_data, problem_data


def walk(*starts, delta=0.2):
    system = cb.DiscreteSystem(lambda x: 0.9 * x, states=["x"], noise=cb.Gaussian(std=0.15))
    safe = [cb.Inside(cb.Box([-1.0], [1.0]))]
    return cb.Problem(system, initial=list(starts), safe=safe, horizon=4, delta=delta, name="walk")


LEFT, RIGHT, NEAR = cb.Box([-0.3], [-0.1]), cb.Box([0.2], [0.3]), cb.Box([0.6], [0.7])


def test_the_bound_is_that_of_the_worst_member_in_any_order():
    own = [cb.verify_safety(walk(start), method="linear").log10_delta for start in (LEFT, NEAR, RIGHT)]
    for starts in ([LEFT, NEAR, RIGHT], [NEAR, RIGHT, LEFT]):
        verdict = cb.verify_safety(walk(*starts), method="linear")
        assert verdict.log10_delta == max(own) == verdict.worst.log10_delta
        assert f"The worst of 3 starts is number {starts.index(NEAR) + 1}" in verdict.reason
        assert [one.log10_delta for one in verdict.members] == [own[[LEFT, NEAR, RIGHT].index(s)] for s in starts]


def test_a_union_is_safe_only_if_every_member_is():
    bounds = [cb.verify_safety(walk(start), method="values").log10_delta for start in (RIGHT, NEAR)]
    between = 10 ** (0.5 * sum(bounds))
    assert cb.verify_safety(walk(RIGHT, LEFT, delta=between), method="values").status == "SAFE"
    verdict = cb.verify_safety(walk(RIGHT, NEAR, delta=between), method="values")
    assert [one.status for one in verdict.members] == ["SAFE", "UNSAFE"]
    assert verdict.status == "UNSAFE"
    assert verdict.log10_lower == verdict.members[1].log10_lower > np.log10(between)
    assert verdict.worst is verdict.members[1]


def test_one_member_whose_noise_free_path_leaves_decides():
    system = cb.DiscreteSystem(lambda x: 1.5 * x, states=["x"], noise=cb.Gaussian(std=1e-3))
    safe = [cb.Inside(cb.Box([-1], [1]))]
    problem = cb.Problem(system, initial=[cb.Box([-0.01], [0.01]), (0.9,)], safe=safe, horizon=2)
    verdict = cb.verify_safety(problem)
    assert verdict.status == "UNSAFE_NOMINAL"
    assert verdict.log10_delta == 0.0
    assert verdict.certificate is None


def test_a_certificate_has_a_proof_of_every_member_and_is_proved_again():
    problem = walk(RIGHT, NEAR)
    verdict = cb.verify_safety(problem, method="linear")
    report = check_data(parse(proved_certificate(problem, verdict)), problem_data(problem))
    assert report.valid, report.reason
    assert report.log10_proved == pytest.approx(verdict.log10_delta, abs=0.1)
    assert "a union of 2" in report.claim


def test_the_proofs_of_all_members_are_checked_once(monkeypatch):
    checked = []

    def seen(data, *given, **options):
        checked.append(data["claim"]["method"])
        return check_data(data, *given, **options)

    problem = walk(RIGHT, NEAR)
    verdict = cb.verify_safety(problem, method="linear")
    monkeypatch.setattr("certbound.checker.check_data", seen)
    proved_certificate(problem, verdict)
    assert checked == ["union"]


FORGERIES = ["swapped", "one proof twice", "one member left out", "one proof for all", "nested"]


@pytest.mark.parametrize("forgery", FORGERIES)
def test_a_forged_twin_is_refused(forgery):
    problem = walk(LEFT, NEAR)
    data = parse(cb.verify_safety(problem, method="linear").certificate_text(problem))
    proof = data["proof"]
    match forgery:
        case "swapped":
            proof["members"].reverse()
        case "one proof twice":
            proof["members"][1] = proof["members"][0]
        case "one member left out":
            del proof["members"][1]
        case "one proof for all":
            data["proof"], data["claim"]["method"] = proof["members"][0], "linear"
        case "nested":
            proof["members"][0] = {"engine": "union", "members": proof["members"]}
    try:
        assert not check_data(data, problem_data(problem)).valid
    except CertificateError:
        pass
    else:
        assert forgery in ("swapped", "one proof twice")


def test_a_certificate_of_one_member_does_not_speak_of_the_union():
    problem = walk(LEFT, NEAR)
    one = walk(LEFT)
    data = parse(cb.verify_safety(one, method="linear").certificate_text(one))
    report = check_data(data, problem_data(problem))
    assert not report.valid
    assert "another problem: initial" in report.reason


def test_it_is_saved_and_loaded(tmp_path):
    problem = walk(LEFT, cb.Ball([0.2], 0.1), (0.5,))
    save(problem, tmp_path / "walk.toml")
    again = load(tmp_path / "walk.toml")
    assert problem_data(again) == problem_data(problem)
    assert (tmp_path / "walk.toml").read_text().count("[[initial]]") == 3
    (tmp_path / "one.toml").write_text((tmp_path / "walk.toml").read_text().replace("[[initial]]", "[initial]", 1))
    with pytest.raises(ValueError, match="not TOML"):
        load(tmp_path / "one.toml")


def test_starts_are_drawn_from_every_member():
    points = walk(LEFT, RIGHT, (0.7,)).initial.sample(np.random.default_rng(0), 9000)[:, 0]
    shares = [np.mean((start.low[0] <= points) & (points <= start.high[0])) for start in (LEFT, RIGHT)]
    assert shares == pytest.approx([1 / 3, 1 / 3], abs=0.02)
    assert np.mean(points == 0.7) == pytest.approx(1 / 3, abs=0.02)
    assert cb.simulate_exits(walk(LEFT, NEAR), paths=500, rng=0, halve=False).exits > 0


def test_a_union_of_one_is_that_set_and_what_wants_one_set_refuses_more():
    assert walk(LEFT).initial is LEFT
    assert isinstance(walk(LEFT, RIGHT).replace(delta=0.1).initial, StartUnion)
    with pytest.raises(InfeasibleError, match="must be one set here, got a union of 2"):
        walk(LEFT, RIGHT).initial.hull()
    with pytest.raises(InfeasibleError, match="must be one set here, got a union of 2"):
        cb.bound_reach(walk(LEFT, RIGHT))


def test_members_must_fit_each_other_and_the_constraints():
    with pytest.raises(ValueError, match=r"must have dimension 1 \(the states\), got 2"):
        walk(LEFT, cb.Box([0, 0], [1, 1]))
    with pytest.raises(ValueError, match="a GaussianStart stands alone"):
        walk(LEFT, cb.GaussianStart([0.0], [[1.0]]))
    with pytest.raises(ValueError, match="a part of it violates"):
        walk(LEFT, cb.Box([0.7], [1.2]))


def test_safe_starts_hold_a_union_only_if_they_hold_every_member():
    for starts, held in (((LEFT, RIGHT), True), ((RIGHT, NEAR), False)):
        found = cb.verify_safety(walk(*starts, delta=0.01), method="values").safe_starts()
        assert found.holds_initial is held


def test_what_is_unsafe_from_one_member_is_not_stated_of_the_union():
    problem = walk(RIGHT, NEAR, delta=1e-6)
    verdict = cb.verify_safety(problem, method="values")
    assert verdict.status == "UNSAFE"
    with pytest.raises(CertificateError, match="verify by itself the member"):
        certificate_data(problem, verdict)
