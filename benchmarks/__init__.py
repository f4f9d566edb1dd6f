"""What the program reaches and what it costs, measured: `python -m benchmarks` lists the questions.

One module a question, each with ``parser()`` and ``main(args)``; what they share is in
`benchmarks.common`, the committed results in ``benchmarks/results``.
"""
