"""The measurements of `scripts/benchsuite`: one module a subject.

The first paragraph of a subject's docstring says what it measures. The module has:

    OPTIONS          its options by name, each an `Option`
    measure(options) measures, and returns the figures as what JSON can hold
    show(result)     prints them for people

and where it needs them:

    EXAMPLES         the examples of all packages to build
    PACKAGES         the packages of PyPI, by the name to import
    verdict(result)  why the result is bad, or None: the exit code is then 1
    PAGE             its options for benches/benchmarks.md, with page(result): rows of figure, peer and ratio
"""
