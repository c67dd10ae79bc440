"""What must hold at the end of the notebook.

The estimates are compared with the spreads of the elements that were drawn, so they differ
only by measurement errors. With ν = S (T − 1) degrees of freedom, the variance of σ_trial² is
(2σ_own⁴ + 4σ_own²σ_trial²) / ν. The variance of σ_subject² is at most 4σ_subject² (σ_own² / T
+ σ_driver²) / (S − 1). The limit of four standard errors is exceeded once in 16 000 by chance.
Without the subtraction of the noise, the same test fails.
"""

# The names are those of the notebook.
# pyright: reportUndefinedVariable=false

assert fits.counts() == {"successful": SUBJECTS * TRIALS * len(TYPICAL)}
nu = SUBJECTS * (TRIALS - 1)
for case in CASES:
    subject, trial, own, shared = found[case]
    true_subject, true_trial = true[case]
    of_trial = np.sqrt((2 * own**2 + 4 * own * true_trial) / nu)
    of_subject = np.sqrt(4 * true_subject * (own / TRIALS + shared) / (SUBJECTS - 1))
    assert abs(trial - true_trial) < 4 * of_trial, case
    assert abs(subject - true_subject) < 4 * of_subject < 0.5 * true_subject, case
    if true_trial == 0:
        assert trial + own > 3 * of_trial, case  # the spread with its noise; 4.5 is expected
    error, noise, driver = common[case]
    assert abs(error) < 4 * np.hypot(noise, driver), case
assert max(abs(error) / noise for error, noise, _ in common.values()) > 5  # the driver, not noise
