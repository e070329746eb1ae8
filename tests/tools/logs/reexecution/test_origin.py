"""The line by which `xrl log resim` says why a run may have come out otherwise."""

from __future__ import annotations

import pytest

from shared import revision
from shared.mcap_log import provenance
from tools.logs.reexecution.origin import Origin, likely_reason

RUN = {
    "git_commit": "1" * 40, "git_dirty": "false", "architecture": "x86_64", "cpu_model": "EPYC",
    "libc": "glibc 2.36", "python": "3.11.2", "platform": "Linux-6.1", "cpu_count": "2",
    "thread_env": '{"OPENBLAS_NUM_THREADS":"1"}',
}  # fmt: skip
PACKAGES = {"casadi": "3.8", "msgspec": "0.22", "numpy": "2.4", "pin": "4.1", "scipy": "1.17"}


def origin(**changes: str) -> Origin:
    run = RUN | {key: value for key, value in changes.items() if key in RUN}
    return {"run": run, "packages": PACKAGES | {k: changes[k] for k in PACKAGES if k in changes}}


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"git_commit": "2" * 40}, "code 222222222222, here 111111111111"),
        ({"git_dirty": "true"}, "code 111111111111 with changes, here 111111111111"),
        ({"architecture": "aarch64"}, "architecture aarch64, here x86_64"),
        ({"cpu_model": "0x41 part 0xd0b"}, "CPU 0x41 part 0xd0b, here EPYC"),
        ({"libc": "glibc 2.41"}, "libc glibc 2.41, here glibc 2.36"),
        ({"python": "3.13.0"}, "Python 3.13.0, here 3.11.2"),
        *(({name: "9"}, f"{name} 9, here {PACKAGES[name]}") for name in PACKAGES),
        ({"thread_env": "{}"}, "OPENBLAS_NUM_THREADS unset, here 1"),
        (
            {"thread_env": '{"OPENBLAS_NUM_THREADS":"1","OPENBLAS_CORETYPE":"Zen"}'},
            "OPENBLAS_CORETYPE Zen, here unset",
        ),
    ],
)
def test_what_differs_is_told(changes: dict[str, str], told: str) -> None:
    assert likely_reason(origin(**changes), origin()) == f"likely reason, recorded with {told}"


def test_all_that_differs_is_told_in_one_line() -> None:
    found = likely_reason(origin(architecture="aarch64", numpy="2.3"), origin())
    assert found == (
        "likely reason, recorded with architecture aarch64, here x86_64; numpy 2.3, here 2.4"
    )


def test_kernel_and_number_of_processors_are_no_reason() -> None:
    found = likely_reason(origin(platform="Linux-6.18", cpu_count="64"), origin())
    assert found == "no reason known: it was recorded with the same as here"


def test_what_a_log_does_not_tell_is_not_taken_for_equal() -> None:
    found = likely_reason(origin(git_commit="unknown", libc="", thread_env="[]"), origin())
    assert found.startswith("no reason known")
    assert found.endswith("(not told: code, libc, OPENBLAS_NUM_THREADS, OPENBLAS_CORETYPE)")
    assert "not told: code, architecture, CPU" in likely_reason({}, origin())


def test_two_checkouts_with_changes_are_not_taken_for_equal() -> None:
    changed = origin(git_dirty="true")
    assert "not told: code" in likely_reason(changed, changed)


def test_every_fact_is_in_what_a_log_is_given() -> None:
    here = {"run": provenance.machine(), "packages": provenance.packages()}
    told = likely_reason(here, origin())
    assert "not told: code)" in told, "the commit is of git, which may not be there"
    assert set(revision.code()) <= set(RUN)
