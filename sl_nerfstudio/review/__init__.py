"""What a scan is judged by, as facts, and the verdict on it: the same for sl-process, sl-check and sl-eval.

In: coordinates and poses of all frames, what registration found out about them. Out: `CrossFrameAgreement` and
`ScanFacts`, facts only; and from these a `Verdict` with its reasons, in sentences.
"""
