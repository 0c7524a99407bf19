"""Threads: how many, the order of chunks, and what is restored afterwards."""

import os
import threading

import pytest
import torch

import cvtgs
from cvtgs.devices import (
    HOST,
    MOST_THREADS,
    core_count,
    in_chunks,
    in_threads,
    kernel_threads,
    one_thread,
    thread_count,
    threads_for_chunks,
)
from scenes import same_bits


def test_searches_use_the_cores_that_the_process_may_use(monkeypatch):
    monkeypatch.setattr("cvtgs.devices.core_count", lambda: 8)
    for limit, found in {"": 8, "3": 3, "99": 8, "0": 1, "4,2": 8}.items():
        monkeypatch.setenv("OMP_NUM_THREADS", limit)
        assert thread_count() == found


def test_the_number_of_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {1, 4}, raising=False)
    assert core_count() == 2
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert core_count() == 1


def test_the_number_of_threads_is_restored_after_an_error():
    before = torch.get_num_threads()
    with pytest.raises(ZeroDivisionError), one_thread():
        divmod(torch.get_num_threads(), 0)
    assert torch.get_num_threads() == before


def test_chunks_are_computed_by_one_thread_each_and_stay_in_order(two_threads):
    together = threading.Barrier(2, timeout=30)

    def function(number):
        if number < 2:
            together.wait()  # passes only if two calls run at the same time
        return number, torch.get_num_threads(), torch.is_grad_enabled()

    with torch.no_grad():
        found = list(in_threads(function, range(9), torch.device("cpu")))
    assert found == [(number, 1, False) for number in range(9)]
    assert torch.get_num_threads() == 2
    with pytest.raises(ZeroDivisionError):
        list(in_threads(lambda number: 1 / number, [1, 0, 2], torch.device("cpu")))
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize(("cores", "share"), [(16, 4), (6, 2)])
def test_chunks_share_few_threads_and_the_caller_does_not_compete(
    two_threads, monkeypatch, cores, share
):
    monkeypatch.setattr("cvtgs.devices.thread_count", lambda: cores)
    torch.set_num_threads(cores)
    meanwhile, all_started = [], threading.Barrier(MOST_THREADS)

    def items():
        for number in range(4 * MOST_THREADS):
            meanwhile.append(torch.get_num_threads())
            yield number

    def function(number):
        if number < MOST_THREADS:
            all_started.wait(30)
        return threading.get_ident(), kernel_threads()

    callers, shares = map(set, zip(*in_threads(function, items(), HOST), strict=True))
    assert len(callers) == MOST_THREADS
    assert threading.get_ident() not in callers
    assert shares == {share}
    assert set(meanwhile) == {1}
    assert torch.get_num_threads() == cores


def test_one_thread_leaves_its_threads_to_kernels(two_threads):
    assert kernel_threads() == 2
    with one_thread():
        assert (torch.get_num_threads(), kernel_threads()) == (1, 2)
        with one_thread():
            assert kernel_threads() == 2
    found = list(in_threads(lambda _: kernel_threads(), range(4), HOST))
    assert found == [1] * 4
    torch.set_num_threads(1)
    with one_thread():
        assert kernel_threads() == 1


def test_one_thread_computes_in_the_calling_thread():
    with one_thread():
        found = in_threads(lambda _: threading.get_ident(), range(3), torch.device("cpu"))
        assert set(found) == {threading.get_ident()}


def test_threads_are_left_to_chunks(two_threads):
    def threads(_):
        return threading.get_ident(), torch.get_num_threads()

    with threads_for_chunks():
        assert (torch.get_num_threads(), kernel_threads()) == (1, 2)
        found = list(in_threads(threads, range(4), HOST))
        assert in_chunks(threads, 5, 10, HOST) == [(threading.get_ident(), 1)]
        with threads_for_chunks(), one_thread():
            assert {own for own, _ in in_threads(threads, range(4), HOST)} != {
                threading.get_ident()
            }
    assert threading.get_ident() not in {own for own, _ in found}
    assert {number for _, number in found} == {1}
    assert torch.get_num_threads() == 2
    with one_thread(), threads_for_chunks():  # the program wants one thread
        assert set(in_threads(threads, range(4), HOST)) == {(threading.get_ident(), 1)}


@pytest.mark.parametrize("policy", ["ACTIVE", "PASSIVE"])
def test_torch_never_splits_an_operation_of_a_simplification(two_threads, monkeypatch, policy):
    """Where its parts start changes last bits, of logistic functions and of sums."""
    monkeypatch.setenv("OMP_WAIT_POLICY", policy)  # idle threads sleep, as on the command line
    counts = set()
    simplifier = cvtgs.Simplifier(
        device="cpu", listener=lambda _: counts.add(torch.get_num_threads())
    )
    simplifier.simplify(cvtgs.synthetic.scene("object", 500, sh_degree=0, seed=0), 0.1)
    assert (counts, torch.get_num_threads()) == ({1}, 2)


@pytest.mark.long
@pytest.mark.parametrize("preset", ["draft", "standard", "paper", "matched", "high"])
def test_results_do_not_depend_on_the_number_of_threads(two_threads, preset):
    sections = {"refine": {"steps": 4}} if preset == "high" else {}
    config = cvtgs.SimplifyConfig.from_mapping({"preset": preset, **sections})
    scene = cvtgs.synthetic.scene("courtyard", 40_000, sh_degree=1, seed=0)
    simplifier = cvtgs.Simplifier(config=config, device="cpu")
    two = simplifier.simplify(scene, 0.1)
    torch.set_num_threads(1)
    assert same_bits(two, simplifier.simplify(scene, 0.1))


def test_ranges_of_rows_cover_all_rows_once_and_an_empty_table_is_one_range():
    found = in_chunks(lambda part: (part.start, part.stop), 5, 2, HOST)
    assert found == [(0, 2), (2, 4), (4, 5)]
    assert in_chunks(lambda part: (part.start, part.stop), 0, 2, HOST) == [(0, 0)]
    there = in_chunks(lambda part: part.stop, 300, 2, torch.device("meta"))  # longer chunks
    assert there == [256, 300]


@pytest.mark.slow
def test_stages_give_the_same_bits_in_two_threads(two_threads, monkeypatch):
    for name in ("allocate.CHUNK", "moments.CHUNK", "inflate.CHUNK", "merge.CHUNK_MEMBERS"):
        monkeypatch.setattr(f"cvtgs.cells.{name}", 100)
    monkeypatch.setattr("cvtgs.mergenet.apply.CHUNK_MEMBERS", 100)
    handed_over = set()

    def recorded(function, items, device):
        handed_over.add(function.__name__)
        return in_threads(function, items, device)

    for module in ("devices", "cells.inflate", "cells.merge", "mergenet.apply"):
        monkeypatch.setattr(f"cvtgs.{module}.in_threads", recorded)
    scene = cvtgs.synthetic.scene("object", 2000, sh_degree=1, seed=0)
    two = cvtgs.Simplifier(device="cpu").simplify(scene, 0.1)
    with one_thread():
        assert same_bits(two, cvtgs.Simplifier(device="cpu").simplify(scene, 0.1))
    in_allocation = {"moments_of", "keys_of", "costs_of", "join", "search"}
    assert handed_over == in_allocation | {"merge_chunk", "inflate", "correct"}


def test_calls_at_the_same_time_restore_the_number_of_threads(two_threads):
    inside, found = threading.Barrier(2, timeout=30), []

    def limited():
        with one_thread():
            inside.wait()  # the second thread of the program starts with a limited torch
            inside.wait()

    def later():
        inside.wait()
        inside.wait()
        with one_thread():
            pass
        found.append(torch.get_num_threads())

    threads = [threading.Thread(target=work) for work in (limited, later)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    fresh = threading.Thread(target=lambda: found.append(torch.get_num_threads()))
    fresh.start()
    fresh.join()
    assert found == [2, 2]


def test_a_limited_call_leaves_threads_alone_that_start_meanwhile(two_threads):
    """A server starts a thread during one call, and uses it after that call."""
    inside, found = threading.Barrier(2, timeout=30), []

    def count():
        found.append(torch.get_num_threads())

    def later():
        count()
        inside.wait()
        inside.wait()  # the other call has ended
        with one_thread():
            count()
        count()

    def run(part):
        inside.wait()  # both threads of the pool are limited
        fresh = threading.Thread(target=count)
        fresh.start()
        fresh.join()
        return torch.get_num_threads()

    worker = threading.Thread(target=later)
    with one_thread():
        worker.start()
        inside.wait()
        assert torch.get_num_threads() == 1
    inside.wait()
    worker.join()
    assert list(in_threads(run, range(2), HOST)) == [1, 1]
    count()
    assert found == [2, 1, 2, 2, 2, 2]


def test_a_number_of_threads_that_the_program_sets_is_kept(two_threads):
    inside, found = threading.Barrier(2, timeout=30), []

    def limited():
        with one_thread():
            inside.wait()
            inside.wait()

    def own():
        inside.wait()
        torch.set_num_threads(3)
        with one_thread():
            assert torch.get_num_threads() == 1
        found.append(torch.get_num_threads())
        inside.wait()

    threads = [threading.Thread(target=work) for work in (limited, own)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [3]


def test_an_interrupted_correction_leaves_no_limit(two_threads, monkeypatch):
    monkeypatch.setattr("cvtgs.mergenet.apply.CHUNK_MEMBERS", 50)

    def refuse(event):
        if event.stage == "network" and event.done:
            raise InterruptedError

    scene = cvtgs.synthetic.scene("object", 2000, sh_degree=0, seed=0)
    with pytest.raises(InterruptedError) as held:
        cvtgs.Simplifier(device="cpu", listener=refuse).simplify(scene, 0.1)
    torch.set_num_threads(1)
    cvtgs.Simplifier(device="cpu").simplify(scene, 0.1)
    assert torch.get_num_threads() == 1
    assert held.value is not None
