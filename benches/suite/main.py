"""Measures the project: one entry for all subjects.

    scripts/benchsuite                              # lists the subjects
    scripts/benchsuite runtime --secs 20 --rounds 5
    scripts/benchsuite runtime svm --quick          # the smallest sizes: whether it works, no figures
    scripts/benchsuite svm --help                   # a subject's options
    scripts/benchsuite --page                       # measures benches/benchmarks.md, and compares it with the last one
    scripts/benchsuite --page runtime --dry-run     # compares one subject, and leaves the page as it is

The sides of a comparison run in turn, round by round, so that whatever else the machine does hits all alike; figures are
medians of the rounds, and ratios medians of the rounds' ratios. Progress goes to stderr. An option applies to each of
the subjects that has it. Needs root's rights, other programs or data sets only where a subject says so. Packages of
Python come from PyPI into target/benchsuite.
"""

import argparse
import importlib
import json
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace

from . import page, programs
from .options import REQUIRED

SUBJECTS = (
    "runtime",
    "rate_max",
    "side_by_side",
    "gaps",
    "soak",
    "recording",
    "python",
    "tactile_source",
    "top",
    "view",
    "machines",
    "robots",
    "simulator",
    "hull",
    "k_means",
    "svm",
    "libsvm",
    "time_step",
    "days",
    "slip",
)


def main(words):
    names = []
    is_page = "--page" in words
    words = [word for word in words if word != "--page"]
    while words and not words[0].startswith("-"):
        names.append(words.pop(0).replace("-", "_"))
    subjects = load(names, is_page)
    if not subjects and not {"-h", "--help"} & set(words):
        list_subjects()
        return 0
    given = parse(subjects, is_page, words)
    packages = {name: package for subject in subjects.values() for name, package in getattr(subject, "PACKAGES", {}).items()}
    if packages:
        programs.use_packages(packages)
    if not given.no_build:
        programs.build({example for subject in subjects.values() for example in getattr(subject, "EXAMPLES", ())})
    machine = programs.describe_machine() | {"command": shlex.join(["scripts/benchsuite", *sys.argv[1:]])}
    if not given.json:
        for name, value in machine.items():
            print(f"{name:<10}{value}", flush=True)
    return run(subjects, given, is_page, machine)


def load(names, is_page):
    """The modules of the named subjects; of those of the page if none is named."""
    unknown = [name for name in names if name not in SUBJECTS]
    if unknown:
        known = ", ".join(SUBJECTS).replace("_", "-")
        fail_usage(f"unknown subject '{unknown[0].replace('_', '-')}', expected some of {known}")
    if is_page and not names:
        names = SUBJECTS
    subjects = {name: importlib.import_module(f".{name}", __package__) for name in names}
    if not is_page:
        return subjects
    of_page = {name: subject for name, subject in subjects.items() if hasattr(subject, "page")}
    if names != SUBJECTS and len(of_page) < len(subjects):
        known = ", ".join(name for name in SUBJECTS if hasattr(importlib.import_module(f".{name}", __package__), "page"))
        fail_usage(f"expected subjects of the page: {known.replace('_', '-')}")
    return of_page


def fail_usage(text):
    print(f"benchsuite: {text}", file=sys.stderr)
    sys.exit(2)


def list_subjects():
    print("Subjects; scripts/benchsuite SUBJECT --help has the options of one:\n")
    for name in SUBJECTS:
        text = importlib.import_module(f".{name}", __package__).__doc__
        first = " ".join(text.split("\n\n")[0].split())
        print(f"  {name.replace('_', '-'):<16}{first}")


def parse(subjects, is_page, words):
    text = "\n".join(subject.__doc__ for subject in subjects.values()) if subjects else __doc__
    parser = argparse.ArgumentParser(
        prog="scripts/benchsuite", description=text, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--quick", action="store_true", help="the smallest sizes: whether it works, no figures")
    parser.add_argument("--no-build", action="store_true", help="use the programs in target/release as they are")
    if is_page:
        parser.add_argument("--dry-run", action="store_true", help="leave the page as it is")
    for name, users in users_of_options(subjects).items():
        about = "; ".join(f"{option_help(subject.OPTIONS[name])} ({user})" for user, subject in users.items())
        parser.add_argument(f"--{name.replace('_', '-')}", dest=name, help=about.replace("%", "%%"))
    given = parser.parse_args(words)
    for name, subject in subjects.items():
        check(parser, name, subject, given)
    return given


def users_of_options(subjects):
    """The subjects that have each option."""
    users = {}
    for user, subject in subjects.items():
        for name in subject.OPTIONS:
            users.setdefault(name, {})[user.replace("_", "-")] = subject
    return users


def option_help(option):
    if option.default is REQUIRED or option.default == Path():
        return option.about
    default = option.default
    if isinstance(default, tuple):
        default = ",".join(f"{one:g}" if isinstance(one, float) else str(one) for one in default)
    if isinstance(default, Path) and default.is_relative_to(programs.PROJECT):
        default = default.relative_to(programs.PROJECT)
    return f"{option.about}; default {default}"


def check(parser, name, subject, given):
    """Ends the program with a message if an option of the subject is wrong or missing."""
    for option_name, option in subject.OPTIONS.items():
        word = f"--{option_name.replace('_', '-')}"
        text = getattr(given, option_name)
        if text is None:
            if option.default is REQUIRED:
                parser.error(f"{name.replace('_', '-')} needs {word}: {option.about}")
            continue
        try:
            value = option.parse(text)
        except ValueError:
            parser.error(f"{word} is '{text}', expected {kind_of(option)}")
        if value == () or not option.is_allowed(value):
            parser.error(f"{word} is '{text}', expected {kind_of(option)} of at least {option.least or 0:g}")


def kind_of(option):
    if isinstance(option.default, tuple):
        return "values with commas between them"
    return {int: "a whole number", float: "a number"}.get(type(option.default), "a path")


def options_for(subject, given, is_page):
    """The options of a subject: those given, else those of the page or of a quick run, else the defaults."""
    values = {}
    for name, option in subject.OPTIONS.items():
        text = getattr(given, name)
        if text is not None:
            values[name] = option.parse(text)
        elif given.quick and option.quick is not None:
            values[name] = option.quick
        else:
            values[name] = subject.PAGE.get(name, option.default) if is_page else option.default
    return SimpleNamespace(**values)


def run(subjects, given, is_page, machine):
    results, pages, bad = {}, [], []
    for name, subject in subjects.items():
        title = name.replace("_", "-")
        result = subject.measure(options_for(subject, given, is_page))
        results[title] = result
        if not given.json:
            print(f"\n== {title}", flush=True)
            subject.show(result)
        wrong = subject.verdict(result) if hasattr(subject, "verdict") else None
        if wrong:
            bad.append(f"{title}: {wrong}")
        if is_page:
            # The page is written after each subject, so that an interrupted run loses none.
            rows, compared = page.compare(subject.page(result))
            pages += compared
            if not given.json:
                page.show(compared)
            if not given.dry_run:
                page.write(rows)
    bad += [f"{row['figure']}: slower by more than a third" for row in pages if row["is_slower"]]
    if given.json:
        print(json.dumps(machine | {"results": results} | ({"page": pages} if is_page else {}), indent=2))
    for text in bad:
        print(f"benchsuite: {text}", file=sys.stderr)
    return 1 if bad else 0
