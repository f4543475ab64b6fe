"""The rank that pays."""

from __future__ import annotations

from pctt.pc.rank_policy import BUDGET, RankPolicy


def use(policy: RankPolicy, cost: dict[int, float], times: int, setup: dict[int, float] | None = None) -> list[int]:
    """Let the policy choose; a use of rank r takes setup[r] + 3 cost[r] seconds for three digits."""
    chosen = []
    for _ in range(times):
        rank = policy.choose()
        policy.report(rank, (setup or {}).get(rank, 0.0) + 3 * cost[rank], 3.0)
        chosen.append(rank)
    return chosen


def test_starts_with_block_jacobi():
    assert RankPolicy((10,)).choose() == 1


def test_takes_the_rank_that_is_faster():
    chosen = use(RankPolicy((10,)), {1: 1.0, 10: 0.2}, 2000)
    assert chosen[0] == 1
    assert chosen[-100:].count(10) >= 95


def test_a_rank_that_does_not_pay_costs_little():
    policy = RankPolicy((10,))
    cost, setup = {1: 1.0, 10: 1.5}, {1: 0.0, 10: 1.0}
    chosen = use(policy, cost, 2000, setup)
    extra = chosen.count(10) * (setup[10] + 3 * cost[10] - 3 * cost[1])
    assert chosen.count(10) > 0
    assert extra <= 1.1 * BUDGET * 3 * cost[1] * len(chosen)


def test_an_unsound_rank_is_not_chosen_again():
    policy = RankPolicy((10,), automatic=False)
    assert policy.choose() == 10
    policy.report(10, 1.0, 0.1, sound=False)
    assert policy.choose() == 1
    policy.forgive()
    assert policy.choose() == 10


def test_rank_one_is_never_banned():
    policy = RankPolicy((10,))
    policy.report(1, 1.0, 0.0, sound=False)
    assert policy.choose() == 1
