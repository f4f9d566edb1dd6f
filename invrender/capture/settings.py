"""Every number of the way from a photo to its lights, with its unit and its source.

One frozen dataclass a step, in the order of the steps. "By hand": chosen by hand, and checked by
`python benchmarks/capture.py --out DIR`, which measures all steps together on simulated photos.
Another source is named where there is one. Relative numbers say of what.
"""

from __future__ import annotations

from dataclasses import dataclass, field

GAUSSIAN_SPREAD = 1.48  # standard deviation over median absolute deviation, of a Gaussian
LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear RGB; Rec. ITU-R BT.709
JPEG_LUMA = (0.299, 0.587, 0.114)  # of encoded RGB; Rec. ITU-R BT.601, as in JFIF
JPEG_GAMMA = 2.2  # exponent of a JPEG's encoding, about; sRGB


@dataclass(frozen=True)
class DampedSteps:
    """Levenberg's and Marquardt's damping: `invrender.capture.least_squares`."""

    first: float = 1e-3  # of the matrix's diagonal; by hand
    factor: float = 8.0  # by which it rises where the cost does, and falls again; by hand
    attempts: int = 6  # of a step, before it is the last; by hand
    ridge: float = 1e-9  # added to the diagonal, where nothing determines an unknown; by hand


@dataclass(frozen=True)
class BallView:
    """The part of a photo around the ball, as the search sees it."""

    toe: float = 0.1  # of the median radiance, added before the logarithm; by hand
    brightest: float = 20.0  # of the median radiance, where the view is cut; by hand
    blurs: tuple[float, ...] = (0.7, 1.4, 2.8, 5.6, 11.2)  # pixels, of the blur levels; by hand
    tensor_blur: float = 1.2  # pixels, before the structure tensor's gradients; by hand
    least_level: float = 1e-6  # of the maximum, the least median of a view; by hand
    least_noise: float = 1e-7  # of the structure tensor's trace; by hand
    edge_blur: float = 3.0  # quarters of a pixel, across a curve; by hand
    edge_steps: int = 4  # positions across a curve to a pixel; by hand
    edge_margin: int = 8  # positions beyond the reach of the search for an edge; by hand
    edge_strength: float = 30.0  # of the median squared slope, of an edge of weight 1/2; by hand
    least_slope: float = 1e-8  # squared, of an edge in a flat place; by hand


@dataclass(frozen=True)
class BallSearch:
    """Where the ball is and how sure that is: `invrender.capture.ball`."""

    radius_deviation: float = 0.10  # of the radius, from what the rig says; by hand
    least_radius: float = 10.0  # pixels; a smaller ball does not show the pattern; by hand
    reach: float = 3.0  # radii from where the rig puts the ball; by hand
    view_margin: float = 1.5  # radii of the view beyond the reach; by hand
    view_radius: float = 48.0  # pixels of the ball in the search's view; by hand
    fit_radius: float = 64.0  # pixels of the ball in the rim fit's view; by hand
    fit_reach: float = 3.3  # radii of the rim fit's view; by hand
    least_confidence: float = 0.5  # below it there is no ball; by hand
    doubtful: float = 0.4  # the same, where the ball shows the pattern; by hand
    certain: float = 0.7  # confidence from which no other place is tried; by hand
    likely: float = 0.65  # the same, where two fits agree; by hand
    same: float = 0.003  # radii between two fits that agree; by hand
    mirror_weight: float = 1.0  # of the mirrored table's fit in the score; by hand
    outline_weight: float = 0.5  # of the outline beside the horizon, likewise; by hand
    tilted_confidence: float = 0.9  # at most, where no square shows the camera's tilt; by hand
    radius_error: float = 0.0012  # of the radius: an expected error of half the doubt; by hand
    doubt: float = 0.4  # of the confidence, lost where the radius is unsure; by hand
    # Confidence before the rim is fitted, below which a further place is left: of 14 photographs
    # balls had 0.29 and more.
    worth_fitting: float = 0.25
    other_radii: tuple[float, float] = (0.93, 1.07)  # of the best fit's, also tried; by hand
    candidates: int = 3  # places refined at first; by hand
    kept: int = 8  # places kept of the coarse search; by hand
    coarse_radii: int = 6  # radii tried within a deviation; by hand
    coarse_points: int = 48  # of a curve in the coarse search; by hand
    coarse_blur: float = 1.5  # pixels, of the edges in the coarse search; by hand
    peak_window: int = 5  # pixels of the coarse search's grid; by hand
    distinct: tuple[float, float] = (6.0, 0.05)  # pixels, of the radius: two places; by hand
    noise_traces: float = 3.0  # of the median edge strength, added to an edge's; by hand
    # Reach in radii, blur level and evaluations of the climbs: first all candidates, then the best.
    climb_first: tuple[float, int, int] = (0.08, 2, 25)  # by hand
    climbs: tuple[tuple[float, int, int], ...] = ((0.04, 1, 40), (0.02, 0, 40))  # by hand
    climb_start: float = 0.25  # of the reach, below the start on each axis; by hand
    climb_precision: tuple[float, float] = (0.02, 1e-4)  # of the reach, of the score; by hand
    climb_prior: float = 0.05  # of the score, a radius one deviation off; by hand
    climb_limit: float = 1.5  # deviations of the radius from which the score drops; by hand
    saturated_disc: float = 0.7  # radii, of the disc that is checked for saturation; by hand


@dataclass(frozen=True)
class MirroredTable:
    """The table seen in the ball against the table seen directly."""

    sines: tuple[float, float, int] = (0.80, 0.99, 14)  # of the normals' angles; by hand
    around: int = 72  # directions of the normals; by hand
    deepest_level: int = 3  # of the blur levels; by hand
    downward: float = 0.05  # z of a mirrored ray that meets the table; by hand
    least_downward: float = 0.02  # the same, in a quotient; by hand
    least_share: float = 0.25  # of the ring that must be in the photo; by hand
    unknown: float = 0.5  # the fit where less is; by hand
    tolerance: float = 0.4  # of log radiance, an error that counts wholly; by hand
    wider: tuple[float, ...] = (1.12, 1.2, 1.28)  # of the radius: circles outside; by hand
    wrong: float = 1.3  # of the radius that must fit worse; by hand
    # Reflectance: distances on the table where it is measured, in radii; and what it may be, of the
    # channels' mean and of each channel about that, relative; by hand.
    measured: tuple[float, float] = (1.3, 4.0)
    reflectances: tuple[float, float] = (0.35, 1.0)
    tint: float = 0.25
    unsaturated: float = 0.9  # of white, below which a value is neither saturated nor beside it
    # Of balls whose reflectance nobody states and the photo does not show: the middle of what
    # `invrender.data.simulate_setup` draws, and the deviation of its logarithm.
    usual: float = 0.65
    usual_deviation: float = 0.2
    independent: float = 20.0  # measurements on the ring that are independent; by hand
    # Of the logarithm of the measured reflectance: the least deviation. On 16 simulated photos at
    # the true place the errors were 0.015 (root mean square) where no glare lay over the ball.
    least_deviation: float = 0.015
    contradiction: float = 3.0  # deviations from which the rig's reflectance is not believed
    least_contradiction: float = 0.07  # and of the logarithm; by hand
    # Logistic regression: the features' weights, and the bias. Fitted to simulated photos with and
    # without a ball; the command that did it is not in the repository.
    weights: tuple[float, ...] = (2.63, 2.79, 2.76, -9.88, -0.19, 13.73)
    bias: float = 5.72


@dataclass(frozen=True)
class RimFit:
    """The last fit of the ball, with the camera's tilt: `invrender.capture.ball_rim`."""

    points_a_pixel: int = 3  # of a line, to each of the view's pixels; by hand
    node_spacing: float = 0.014  # radii, of the unknown table's nodes; by hand
    roughness: float = 0.03  # of the median: the table's typical second difference; by hand
    nearest: float = 0.80  # radii where the lines begin; by hand
    farthest: float = 3.0  # radii to which the table is looked up; by hand
    # Lines, blur in the view's pixels, radii to which the table is unknown, steps at most, radii to
    # start from.
    stages: tuple[tuple[int, float, float, int, tuple[float, ...]], ...] = (
        (48, 2.0, 1.08, 4, (0.95, 0.975, 1.0, 1.025, 1.05)),
        (64, 1.0, 1.15, 6, (1.0,)),
        (144, 0.0, 1.25, 10, (1.0,)),
    )  # by hand
    starts: int = 2  # of a stage's starts that are followed, the likeliest; by hand
    tilt_deviation: float = 1.5  # degrees, of the camera's tilt from the rig's; by hand
    blur_deviation: float = 0.15  # of the logarithm of the camera's blur; by hand
    reflectance_deviation: float = 0.01  # of the logarithm of the mirror's; by hand
    expected_blur: float = 0.8  # of the view's pixels; by hand
    outlier: float = 4.0  # spreads, of a pixel that is replaced; by hand
    robust: float = 1.25  # spreads from which a residual counts less; by hand
    first_spread: float = 0.01  # of the radiance, before it is measured; by hand
    least_spread: float = 0.004  # of the radiance, the least; by hand
    horizon_spread: float = 0.5  # pixels, the least of the horizon's edge; by hand
    correlated: float = 12.0  # neighbouring residuals that count as one; by hand
    edges_correlated: float = 10.0  # the same, of the horizon's edges; by hand
    horizon_points: int = 120  # of the horizon's curve; by hand
    horizon_reach: tuple[float, float] = (2.0, 0.05)  # pixels at least, radii; by hand
    strong_edge: float = 0.1  # weight of an edge that counts for the spread; by hand
    steps: tuple[float, ...] = (2e-3, 2e-3, 2e-3, 0.1, 0.1, 0.05, 0.01)  # radii, degrees, logs
    position_precision: float = 1e-9  # of the prior on place and radius; by hand
    margin: float = 4.0  # pixels of a line beyond its samples; by hand
    toward: float = 1.3  # radii, of the point that gives a line's direction; by hand
    downward: float = 0.03  # z of a mirrored ray that meets the table; by hand
    least_downward: float = 1e-3  # the same, in a quotient; by hand
    last_node: float = 0.98  # radii, where the nodes begin; by hand
    inside_last: float = 1e-3  # of a node, kept below the last one; by hand
    hidden_share: float = 0.02  # of a sample that the photo does not show; by hand
    dark: tuple[float, float] = (1e-3, 1e-9)  # of the mean, absolute: the least scale; by hand
    ridge: float = 1e-6  # on the unknown table's nodes; by hand
    unseen_cost: float = 0.25  # squared spreads, of a sample that the photo leaves open; by hand
    longest_step: float = 8.0  # steps; by hand
    least_gain: float = 0.05  # of the cost; a smaller gain ends the descent; by hand


@dataclass(frozen=True)
class SquareFit:
    """The camera's pose from the sample's square: `invrender.capture.camera`."""

    pieces: int = 8  # of a side; by hand
    points: int = 16  # of a piece; by hand
    inset: float = 0.03  # of a side, left out at each end; by hand
    shift_deviation: float = 0.028  # sides, of the camera's place; by hand
    tilt_deviation: float = 1.5  # degrees, of the camera's tilt; by hand
    blur: float = 1.7  # pixels, of the changes across a side; by hand
    wide_blur: float = 0.013  # sides, likewise; by hand
    border_deviation: tuple[float, float] = (0.3, 0.5)  # pixels: place and slope; by hand
    least_change: float = 0.3  # of the greatest near a side's points, at its border; by hand
    best: int = 5  # lines of a side that are combined; by hand
    # Pixels of a side, reach in sides, rounds, slope in sides; in pixels the spacing of the places
    # tried, and the deviations of a line's place and slope.
    passes: tuple[tuple[int, float, int, float, float, float, float], ...] = (
        (256, 0.15, 1, 0.06, 1.0, 1.0, 1.5),
        (512, 0.02, 2, 0.015, 0.5, 0.8, 1.2),
    )  # by hand
    view_margin: float = 1.5  # of the first pass's reach; by hand
    # A square farther away than that. Sides within which its middle may lie, and from which it is
    # far; pixels of a side; sizes and turns (degrees) that are tried; by hand.
    far: float = 0.5
    far_off: float = 0.05
    far_pixels: int = 48
    far_scales: tuple[float, ...] = (0.95, 1.0, 1.05)
    far_turns: tuple[float, ...] = (-2.5, 0.0, 2.5)
    # Pixels, of the slopes of the tone; how many times their median, and by how much, a change is
    # larger; pixels outside a side that should have none; how clear the square must be; by hand.
    far_blur: float = 1.0
    far_change: tuple[float, float] = (3.0, 0.02)
    far_beside: tuple[float, ...] = (4.0, 6.0)
    far_beyond: tuple[float, float] = (0.1, 0.35)  # sides, from a corner: no change either
    far_clear: float = 0.5
    far_alike: float = 0.06  # less clear are squares that count as well; by hand
    far_near: float = 5.0  # pixels, from the clearest, of these; by hand
    far_reaches: tuple[float, ...] = (0.06, 0.15)  # sides, of the border's search; by hand
    far_deviation: float = 0.3  # pixels, of its sides; by hand
    greatest_misfit: float = 25.0  # squared deviations of the lines; two are left over; by hand
    greatest_pose: float = 18.0  # squared deviations of the pose, six numbers; by hand
    surely: float = 2.5  # times that, where all four sides are clear lines; by hand
    # Of three sides, the changes on the line must exceed by `clear` the greatest tenth of those
    # beside it, and `most` of the points change most there; or the whole side's by `whole`.
    clear: float = 2.0  # ratio; by hand
    most: float = 0.5  # share of a side's points; by hand
    whole: float = 10.0  # ratio; by hand
    nominal: float = 12.0  # ratio to the median, from which the rig's own square is seen; by hand
    better: float = 1.8  # sum of four logarithms, from which another square is the one; by hand
    # The same of the border from outside, where the rig's own square is seen; by hand.
    clearer: float = 0.5
    least_side: int = 32  # pixels of a side that can be seen; by hand
    least_move: float = 0.004  # sides; a smaller one is not believed; by hand
    found_tilt: float = 0.3  # degrees, expected error of the tilt by the square; by hand
    unseen_tilt: float = 2.0  # degrees, expected tilt where no square is seen; by hand
    slope_step: float = 0.05  # deviations, of the finite differences; by hand
    # Pixels outwards, of the search for the border: from, to, and where it may lie at most.
    outward: tuple[float, float, float] = (-12.0, 24.5, 9.0)  # by hand
    behind: int = 7  # half pixels, the change's peak behind its first sight; by hand
    table_change: float = 2.5  # of the table's greatest twentieth, at the border; by hand
    table_quantile: float = 0.95  # by hand
    rounds: int = 10  # of the border's robust line; by hand
    ridge: float = 1e-6  # on that line's place and slope; by hand
    near: tuple[float, float, float] = (30, 1.0, 4.0)  # half pixels seen; on, beside; by hand
    peak_on: float = 1.5  # pixels, of a change that is on the line; by hand
    wide: tuple[float, float, float] = (60, 3.0, 20.0)  # pixels, as `near`; by hand
    tenth: float = 0.9  # quantile; by hand
    least_power: tuple[float, float, float] = (1e-3, 1e-4, 1e-9)  # on, beside, whole; by hand
    even: tuple[float, float] = (4.0, 1e-6)  # of the median change, absolute; by hand
    beside: float = 8.0  # pixels, beside a line, between which the tone must change; by hand
    left_out: float = 100.0  # times the deviations, of a side that does not fit; by hand


@dataclass(frozen=True)
class SheetFit:
    """The capture sheet in a photo: `invrender.capture.sheet`."""

    # Pixels of a marker where the rig expects it, in the copy that is searched, and in the next one
    # where there are any.
    copy_markers: tuple[float, ...] = (40.0, 80.0)  # by hand
    skipped: float = 0.8  # of the copy's shrinking, done by leaving pixels out; by hand
    toe: float = 0.1  # of the median radiance, added before the logarithm; by hand
    brightest: float = 20.0  # of the median radiance, where the copy is cut; by hand
    least_level: float = 1e-6  # of the maximum, the least median; by hand
    window: int = 21  # pixels of the copy, of its adaptive threshold; by hand
    least_marker: float = 0.35  # of the expected marker's side, that is read; by hand
    cell_pixels: int = 8  # of a module, when it is read; by hand
    cell_margin: float = 0.25  # of a module, left out at each side; by hand
    corrected: float = 0.4  # of the bits that a dictionary can correct; by hand
    least_markers: int = 3  # by which a sheet is used; by hand
    in_place: float = 0.25  # markers' sides, from where the others say it is; by hand
    least_in_place: float = 0.6  # of the markers, that must be; by hand
    # Reach across an edge: modules, pixels at most.
    passes: tuple[tuple[float, float], ...] = ((0.6, 1e3), (0.6, 6.0))  # by hand
    farthest: float = 1.5  # of the reach, that a corner may move; two edges' lines give 1.41
    edge_points: int = 12  # of an edge; by hand
    edge_samples: int = 24  # across it; by hand
    edge_inset: float = 0.12  # of an edge, left out at each end; by hand
    end_samples: int = 4  # that show ink or paper alone; by hand
    rounds: int = 3  # of an edge's robust line; by hand
    least_spread: float = 0.01  # pixels; by hand
    outlier: float = 3.0  # spreads; by hand
    # Before the photo is seen. In heights of the camera: its place aside, and its height where the
    # focal length is known, or not; of the logarithm of the focal length, from rig.toml or from
    # EXIF's whole millimetres.
    place_deviation: float = 0.3  # by hand
    height_deviation: tuple[float, float] = (0.3, 0.05)  # by hand
    focal_deviation: dict[str, float] = field(default_factory=lambda: {"rig": 0.005, "exif": 0.015})
    unknown_focal_deviation: float = 0.5  # by hand
    contradiction: float = 3.0  # deviations from which a stated one is not believed; by hand
    ink_deviation: float = 0.01  # markers' sides; by hand
    distortion_deviation: float = 0.05  # k1; by hand
    # Of the photo's width, the optical axis from its middle: in whole and in cropped photos.
    centre_deviation: float = 0.003  # by hand
    cropped_deviation: float = 0.2  # by hand
    step: float = 0.01  # heights, radians: the numbers' scale in the solver; by hand
    first_deviation: float = 0.2  # pixels, of a corner, before it is measured; by hand
    least_deviation: float = 0.02  # pixels; by hand
    robust: float = 2.0  # deviations from which a corner counts less; by hand
    greatest_misfit: float = 0.03  # of a marker's side, in the photo: another sheet, or not flat
    fits: int = 3  # with the deviation from the one before; by hand
    least_aside: float = 0.3  # of the ball's distance from the sample's middle; by hand
    least_bend: float = 0.5  # pixels by which distortion must move a corner to be undone; by hand
    sure: float = 3.0  # its deviations, likewise; by hand
    largest_off: float = 0.01  # widths by which the photo may grow without black borders; by hand
    least_module: float = 5.0  # pixels of a marker's module, whose ink is measured; by hand
    patch_points: int = 6  # a side of a square of paper; by hand
    patch_inside: float = 0.6  # of its side; by hand
    patch_noise: float = 0.03  # of its radiance; by hand
    least_patches: int = 8  # squares of paper that tell the gain; by hand
    darker: float = 1.0  # logarithm of the paper's radiance over a sample's, about; by hand
    screen_cells: int = 24  # of the screen, a side; by hand
    environment_rows: int = 32  # by hand
    room_deviation: float = 0.5  # of the room's factor about 1; by hand
    vignetting_deviation: float = 0.3  # of the light that a corner lacks; by hand
    most_vignetting: float = 0.9  # of that; by hand
    gains_differ: float = 3.0  # deviations between the gains by paper and ball; by hand
    useful: float = (
        0.5  # deviation of its logarithm to which the gain by paper says something; by hand
    )
    scale: float = 0.02  # of the ball's radius, by which it contradicts the sheet's; by hand


@dataclass(frozen=True)
class Exposure:
    """What is wrong with a photo in which no ball or pattern is found; by hand."""

    saturated: float = 0.3  # share of its pixels
    dark: float = 0.004  # median over white: one step of 8 bits
    grey: float = 1e-3  # greatest difference of channels over the brightest value


@dataclass(frozen=True)
class Orientation:
    """Which way round photo and pattern are: `invrender.capture.orientation`."""

    cells: int = 24  # of the pattern, a side, as it is compared; by hand
    alike: float = 0.7  # correlation from which another orientation is shown; by hand
    better: float = 0.3  # by which it must exceed the expected one's; by hand
    # Correlation below which the pattern is another one; 25 hard simulated photos had 0.82.
    unlike: float = 0.5
    flat: float = 0.05  # standard deviation of a pattern without sides to tell; by hand
    least_spread: float = 1e-3  # of the means' product, of a channel that counts; by hand
    saturated: float = 0.98  # of white, beside which a look-up of a saturated pixel lies; by hand
    brightest: float = 0.05  # share of cells whose brightness does not count; by hand
    telling: float = 0.3  # share of the screen that must not be white to tell the pattern; by hand


@dataclass(frozen=True)
class FieldOfView:
    """The field of view by the ball's size, where neither rig.toml nor EXIF gives it."""

    narrowest: float = 35.0  # degrees across the photo; a 57 mm equivalent lens; by hand
    widest: float = 95.0  # degrees; a 16 mm equivalent lens; by hand
    step: float = 1.15  # of the focal length, between two tries; by hand
    tries: int = 3  # likeliest ones in which the ball is fitted; by hand
    candidates: int = 1  # places refined with each focal length; by hand
    settled: float = 0.05  # of the focal length: a change after which no further fit is made
    certain: float = 0.85  # confidence of a ball after which no other focal length is tried
    rounds: int = 2  # of the ball's fit, each with the field of view from the one before; by hand


@dataclass(frozen=True)
class Cropping:
    """How a cropped photo is recognised: `invrender.capture.orientation`."""

    # Width over height of whole photos, the longer side first; what cameras and phones have.
    ratios: tuple[float, ...] = (1.0, 5 / 4, 4 / 3, 7 / 5, 3 / 2, 16 / 10, 16 / 9, 2.0)
    tolerance: float = 0.01  # of the ratio: raw files have some columns more; by hand
    off_centre: float = 0.5  # radii, of the ball from where the rig puts it; by hand


@dataclass(frozen=True)
class WhichPattern:
    """Of a set's patterns; chosen by hand: halves, gradients and stripes of one set are alike to
    0.9 at most."""

    alike: float = 0.6  # least correlation with the pattern that is shown
    better: float = 0.03  # than with any other


@dataclass(frozen=True)
class BallShape:
    """Hemisphere or full sphere, where nobody states it: `invrender.capture.orientation`."""

    # Confidence of a hemisphere, less its radius's relative error, from which no sphere is tried.
    certain: float = 0.8  # by hand
    # Of that error against the confidence, where the capture sheet measures the radius; by hand, on
    # 15 photographs. Elsewhere 1.
    sheet_weight: float = 3.0


@dataclass(frozen=True)
class TableLevel:
    """The table's tilt against the camera: `invrender.capture.lights.level_table`."""

    # Degrees; a smaller one is an error of the rim's fit. Of 73 noisy photographs with a straight
    # camera one was found tilted by 1.9 (four deviations), the next by 1.6 (seven).
    least_tilt: float = 1.75
    least_deviations: float = 4.0  # of the rim's fit, likewise; its errors are twice these; by hand


@dataclass(frozen=True)
class GlareFit:
    """Veiling glare over the ball: `invrender.capture.glare`."""

    # Of the residuals' cost, at most so much may be left, or the glare is not removed; by hand.
    cost_ratio: float = 0.7
    bare: float = 1.8  # radii from which the mirrored table is clear of the ball's shadow; by hand
    downward: float = 0.02  # z of a mirrored ray that meets the table; by hand
    least_downward: float = 1e-3  # the same, in a quotient; by hand
    sample: float = 0.51  # sizes of the sample within which the table may shine; by hand
    directions: int = 12  # of the centres to start from; by hand
    start_width: float = 0.4  # radii, of the Gaussian to start from; by hand
    widths: tuple[float, float] = (0.1, 1.0)  # radii; by hand
    farthest: float = 2.0  # radii, of its centre on each axis; by hand
    precision: float = 1e-6  # of the cost; by hand
    pixels: int = 2000  # of the ball's that are compared, at least, where it has so many; by hand


@dataclass(frozen=True)
class ScreenFit:
    """The screen's pose, curve and gain from its image in the ball: `invrender.capture.screen`."""

    shift_deviation: float = 6e-3 / 0.09  # sizes of the sample; by hand
    tilt_deviation: float = 6.0  # degrees; by hand
    gamma_deviation: float = 0.5  # of the logarithm of the display's gamma; by hand
    channel_deviation: float = 0.03  # of the channels about their mean, likewise; by hand
    white_deviation: float = 0.25  # of log gains about their mean, if much is saturated; by hand
    expected_blur: float = 0.5  # pixels; by hand
    blur_deviation: float = 0.7  # of the blurs' logarithms; by hand
    colour_blur: float = 0.9  # pixels, of colours in a JPEG at half the resolution; by hand
    colour_pooling: float = 1.5  # pixels, of the colours in photo and model alike; by hand
    finest: float = 100.0  # pixels; a larger ball is shrunk for the fit; by hand
    cells: int = 128  # of the pattern in the fit, a side; by hand
    poor: float = 0.01  # residual from which the nominal screen is in doubt; by hand
    good: float = 0.02  # residual from which the display may dim to the sides; by hand
    better: float = 50.0  # half a chi-squared, by which another pose must be likelier; by hand
    saturated: float = 0.01  # share of saturated pixels that counts; by hand
    # Shares from which a tone curve cannot be told, so that the display's curve is taken as usual;
    # and from which nothing of the display can but gain and pose; by hand.
    no_curve: float = 0.2
    no_display: float = 0.6
    # Pixels of blur through which the screen is looked for, and the share of the cost that a step
    # must gain. Through the greatest blur the room behind the screen is vague: a few steps, and it
    # is estimated anew.
    stages: tuple[tuple[float, float], ...] = (
        (2.5, 0.03),
        (2.5, 0.03),
        (1.0, 1e-2),
        (0.0, 1e-3),
        (0.0, 1e-6),
    )  # by hand
    stage_radius: float = 60.0  # pixels of a ball for which the stages' blurs are meant; by hand
    edge: int = 3  # pixels outside the screen's image that are compared as well; by hand
    robust: float = 2.5  # deviations from which an error counts less; by hand
    difference: float = 0.02  # of the unknowns, in finite differences; by hand
    upward: tuple[float, float] = (0.02, 0.05)  # z of a mirrored ray to the screen; by hand
    near: float = 0.75  # sizes from the screen's middle that may show it; by hand
    window_margin: float = 0.06  # radii; by hand
    # Sub-pixels a side for balls up to so many pixels in radius; by hand.
    sub_pixels: tuple[tuple[float, int], ...] = ((50.0, 4), (80.0, 3), (float("inf"), 2))
    least_pattern: float = 1e-3  # of the pattern, below a display's black; by hand
    inside: float = 0.98  # share of the screen in a pixel that lies on it; by hand
    outside: float = 0.003  # share of the screen in a pixel beside it; by hand
    least_inside: int = 12  # pixels on the screen; by hand
    least_part: float = 0.4  # of those of the nominal screen, that it has elsewhere; by hand
    room_window: int = 5  # pixels, of the room's mean and spread; by hand
    room_spread: float = 0.1  # of the room's radiance, at least; by hand
    room_margin: float = 2.0  # pixels, and as many for each of blur; by hand
    least_share: float = 1e-6  # of the room in a window, in a quotient; by hand
    dark_noise: float = 0.02  # of the gain, added to the shot noise's level; by hand
    least_noise: float = 0.003  # of the shot noise's scale; by hand
    first_noise: float = 0.1  # of it, where nothing shows it; by hand
    least_radiance: tuple[float, float] = (1e-6, 1e-3)  # linear, encoded; by hand
    least_width: float = 1e-6  # of a sub-pixel on the screen; by hand
    last_cell: float = 1.001  # cells from the pattern's border in a look-up; by hand
    longest_step: float = 0.5  # of the unknowns; by hand
    steps: int = 60  # at most; by hand
    correlated: float = 3.0  # by which neighbours' like errors raise a deviation; by hand


@dataclass(frozen=True)
class Display:
    """What displays are like beyond a gamma, where the errors ask for it:
    `invrender.capture.screen`. Deviations about nought."""

    falloff_deviation: float = 1.0  # of the exponent; measured displays have 0.3 to 1.6
    greatest_falloff: float = 3.0  # of any; by hand
    # Where the screen is too saturated to tell: the middle of those, and the deviation.
    usual_falloff: float = 0.95
    usual_deviation: float = 0.4
    black_deviation: float = 0.01  # relative to white; by hand
    mixing_deviation: float = 0.05  # of a channel's light in another; measured: 0.01 to 0.09
    # Of the logarithm of the display's gamma; measured displays have gammas of 0.92 to 1.12.
    gamma_deviation: float = 0.06
    sample: float = 0.1  # of white, the radiance of a sample, about; by hand
    brightest_sample: float = 0.3  # of a file's white, at most; by hand
    least_gain: float = 0.04  # of the cost, that further unknowns must explain; by hand


@dataclass(frozen=True)
class ToneCurve:
    """The tone curve of an 8-bit file: `invrender.capture.response`."""

    # Of the logarithm of light over value at white, at least: a camera's curve flattens there.
    shoulder: float = 0.12
    # By how much a slope between grey and white may exceed the one before it; a false curve's did
    # by 0.95. By hand.
    steeper: float = 0.4
    fixed_deviation: float = 1e-3  # of the fixed knot's logarithm; by hand
    darkest: float = 1e-6  # linear; by hand
    least_slope: float = 0.1  # of the whole curve, in logarithms, that can be undone; by hand
    ink_noise: float = 0.05  # of log paper over ink, from marker to marker; by hand
    independent: float = 30.0  # such measurements that are, at most; by hand
    parts: int = 16  # of a photo, one after the other, to save memory; by hand


@dataclass(frozen=True)
class PatternCheck:
    """Whether the ball shows the pattern, and whether the screen hangs elsewhere."""

    # Residual of the ideal pattern from which the ball shows another one, or is none: nine hard
    # simulated balls had at most 0.12, nine wrong ones at least 0.29.
    not_the_pattern: float = 0.22
    certain: float = 0.75  # confidence from which a ball is one however the pattern fits; by hand
    # What an error of the ball's place, a hundredth of its radius, explains; by hand.
    least_shift: float = 0.022  # sizes of the sample
    least_tilt: float = 1.0  # degrees
    captured_size: int = 256  # pixels a side, at most, of the pattern as the ball shows it; by hand
    room_saturated: float = 0.001  # share of the room that makes a notice; by hand


@dataclass(frozen=True)
class Unfolding:
    """The environment from the ball's image: `invrender.capture.environment`."""

    height: int = 128  # rows of the environment; by hand
    samples: int = 4  # directions a side of a texel; by hand
    # Pixels around the screen's image that may hold some of its light, and for each of the camera's
    # blur: the screen is often a hundred times as bright as the room beside it; by hand.
    screen_margin: float = 1.5
    margin_a_blur: float = 1.5
    hidden: float = 0.01  # share of the screen in a look-up that hides the room; by hand
    # Of the screen's white, above the screen's own light, from which a pixel near it is a lamp's;
    # share of such a pixel in a look-up that is one; pixels of blur, at least, since the screen's
    # place is known no better; by hand.
    brighter: float = 0.3
    lamp_shown: float = 0.5
    least_blur: float = 0.5
    floor: float = 1e-3  # of the mean, the least radiance that is continued; by hand
    least_floor: float = 1e-9  # absolute; by hand
    window_margin: float = 4.0  # pixels around the ball's outline; by hand


@dataclass(frozen=True)
class TableMeter:
    """The table as a light meter: `invrender.capture.table`."""

    blocks: int = 64  # across the photo; by hand
    block_pixels: int = 32  # of a block that count, a side, at most about; by hand
    screen_cells: int = 16  # of the screen, a side; by hand
    environment_rows: int = 32  # by hand
    least_pairs: int = 50  # of blocks, of one lag and way; by hand
    lags: tuple[int, ...] = (8, 16, 32)  # blocks between those that are compared; by hand
    downward: float = 0.2  # z of a ray that meets the table; by hand
    sample_margin: float = 1.5  # blocks around the sample that do not count; by hand
    ball_margin: float = 3.0  # radii around the ball that do not count; by hand
    at_once: int = 2_000_000  # pairs of a point and a direction in memory
    # Standard deviation of the logarithm from block to block, at least: rounding to 8 bits too.
    least_spread: float = 0.02


@dataclass(frozen=True)
class ClippedLamps:
    """Lamps that the photo clips: `invrender.capture.clipped_lamps`."""

    # Logarithm of how many times brighter than the clipping level what is clipped is: mean,
    # standard deviation, and that of the channels; `python benchmarks/clipped.py --out DIR`.
    mean: float = 0.5
    deviation: float = 1.0
    channel_deviation: float = 0.25
    # Deviation of the log gain from which the screen is measured by the table too; by what that is
    # multiplied where some of the screen is saturated; and of the channels, in that; by hand.
    known_gain: float = 0.1
    gain_doubt: float = 1.0
    channel_doubt: float = 0.5
    # What the camera adds: deviations of the power that a tone curve leaves, at least, and of the
    # share of light that a corner lacks; phones' JPEGs lack up to 0.15.
    least_power: float = 0.01
    vignetting: float = 0.08
    # The table is believed where its errors with another gain are so small, in logarithms; by hand.
    plain: float = 0.06
    likely_gain: float = 2.0  # deviations, in that, by which it may differ; by hand
    greatest: float = 6.0  # by hand
    # Of white, from which a channel is clipped in a lamp that is clipped in others alone; by hand.
    beside: float = 0.8
    starts: tuple[float, float, int] = (0.05, 4, 10)  # from, to, number; by hand
    inside: float = 1e-6  # distance of a start from the bounds; by hand


@dataclass(frozen=True)
class Strength:
    """How well the light on the sample is known: `invrender.capture.strength`."""

    # Of the logarithm of the light: from where the screen hides the room from the ball, as it is
    # filled; of lamps seen right beside the screen; of raised lamps, besides what their fit says.
    # Of 44 simulated captures' true rooms (docs/research-log/2026-11-30-the-lights-strength.md).
    hidden: float = 0.78
    beside: float = 0.2
    lamps: float = 0.5
    hidden_lamp: float = 0.3  # of a lamp there that the table's shading shows; by hand
    warned: float = 0.06  # of the logarithm of all light, from which a person is told; by hand


@dataclass(frozen=True)
class Vignetting:
    """What a lens loses towards the corners: `invrender.capture.vignetting`."""

    most: float = 0.6  # share of light that corners lack; by hand
    steps: int = 61
    # Errors of the table's log brightness with it, at most, and over those without; by hand.
    plain: float = 0.06
    ratio: float = 0.75


@dataclass(frozen=True)
class NearLampSearch:
    """A lamp that is near: `invrender.capture.near_lamp`."""

    bright: float = 5.0  # of the sky's median radiance, a lamp's; by hand
    share: float = 0.3  # of the light on the table, that it gives at least; by hand
    widest: float = 25.0  # degrees, root mean square about its middle; by hand
    nearest: float = 2.0  # sizes of the sample; by hand
    steps: int = 61  # of its nearness, from nought; by hand
    # Spread of the table's brightness with the distance over that without, at most; by hand.
    ratio: float = 0.9


@dataclass(frozen=True)
class HiddenLamp:
    """A lamp behind the screen: `invrender.capture.hidden_lamp`."""

    parts: int = 8  # of what the screen hides from the ball, a side; by hand
    tile: int = 16  # blocks a side, over which the errors' correlation is measured; by hand
    # Of the logarithm of how many times brighter a part is than its filling: half the range between
    # the quartiles of a Cauchy distribution, and the channels' standard deviation. In rooms one
    # part in a hundred has 3 to 5: a lamp.
    quartile: float = 0.3
    channel_deviation: float = 0.12
    greatest: float = 9.0  # by hand
    starts: tuple[float, ...] = (0.1, 0.4, 1.5)  # of the table's light, of a lamp; by hand
    gain: float = 6.0  # of twice the log posterior, that a lamp must bring; by hand
    # Of the spread of the table's brightness, at most so much may be left with the lamp; by hand.
    spread_ratio: float = 0.82
    white_pull: float = 0.13  # mean squared influence of a Gaussian error under Cauchy's loss
    inside: float = 1e-3  # distance of a start from the bound; by hand


@dataclass(frozen=True)
class Crop:
    """The sample cut out of the photo: `invrender.capture.crop`."""

    samples: int = 8  # a side of a pixel, at most; beyond, the photo is smoothed first; by hand
    sharp_samples: int = 3  # and at least, of a sharp crop: its means are means over the pixels
    margin: int = 8  # pixels around the sample's square; by hand
    mask_margin: int = 10  # the same, of the saturated pixels; by hand
    spline_scale: float = 2.0  # photo pixels in a pixel, below which splines are used; by hand
    # Pixels at the sample's border that show its surroundings too, of a photo so wide (pixels) or
    # narrower: benchmarks/device.py's lenses blur by up to 0.8.
    edge: float = 2.0
    edge_width: float = 1280.0
    spline_margin: int = 12  # pixels, which `scipy.ndimage.map_coordinates` adds; its own number
    band: int = 1 << 19  # samples that are taken at once
    touched: float = 0.05  # share of saturated pixels in one that counts as saturated; by hand
    tolerance: float = 0.5  # pixels that the sample may reach beyond the photo; by hand
    beyond: float = 1.01  # halves of the side, of what another photo shows; by hand


@dataclass(frozen=True)
class BallShade:
    """The ball's shadow on the sample: `invrender.capture.ball_shade`; chosen by hand."""

    side: int = 128  # of the sample's square, where lamps throw it
    coarse: int = 16  # the same, for other light
    lamp: float = 1e-3  # share of the room's light, from which a texel is a lamp's
    least: float = 0.03  # share of the light that a shadow takes somewhere
    darkest: float = 0.02  # share of the light that is left
    spreads: tuple[float, ...] = (1.0, 0.5, 0.2)  # widths of lamps over those in the environment
    smooth: float = 1.0  # pixels, before slopes
    steep: float = 0.1  # of the shadow's greatest slope, where it is compared
    rounds: int = 10
    weakest: float = 0.4  # of the shadow's strength, in the photo
    strongest: float = 1.6
    most_left: float = 0.9  # share of the photo's slopes, that is left


@dataclass(frozen=True)
class ScreenShade:
    """The screen's shadow on the sample: `invrender.capture.screen_shade`; chosen by hand on three
    photographs (docs/research-log/2026-11-30-the-edge-of-the-screens-shadow.md)."""

    side: int = 64  # of the sample's square, where lamps throw it
    coarse: int = 16  # the same, for other light
    lamp: float = 1e-3  # share of the room's light, from which a texel is a lamp's
    texels: int = 150  # of a lamp, at most: the shadows of wider ones have no edge
    lamps: int = 3  # at most, the ones whose shadows are deepest
    least: float = 0.1  # share of the light that a shadow takes
    least_cosine: float = 0.05  # to the screen's normal
    shift: float = 0.5  # texels that a lamp is off by, a standard deviation
    width: float = 1.0  # of the logarithm of its width, likewise
    narrower: float = -0.7  # that logarithm, where the search begins
    reach: float = 1.0  # texels, by which the shadow is looked for beyond its place
    steep: float = 0.1  # of its greatest slope, from which that counts
    smooth: float = 0.7  # pixels, before slopes
    step: float = 0.02  # of the search's differences
    rounds: int = 25
    better: float = 0.95  # cost over that of the lamp as it is
    rows: int = 256  # of the environment with the narrower lamp


DAMPED_STEPS = DampedSteps()
BALL_VIEW = BallView()
BALL_SEARCH = BallSearch()
MIRRORED_TABLE = MirroredTable()
RIM_FIT = RimFit()
SQUARE_FIT = SquareFit()
SHEET_FIT = SheetFit()
EXPOSURE = Exposure()
ORIENTATION = Orientation()
WHICH_PATTERN = WhichPattern()
BALL_SHAPE = BallShape()
FIELD_OF_VIEW = FieldOfView()
CROPPING = Cropping()
TABLE_LEVEL = TableLevel()
GLARE_FIT = GlareFit()
SCREEN_FIT = ScreenFit()
DISPLAY = Display()
TONE_CURVE = ToneCurve()
PATTERN_CHECK = PatternCheck()
UNFOLDING = Unfolding()
TABLE_METER = TableMeter()
CLIPPED_LAMPS = ClippedLamps()
STRENGTH = Strength()
VIGNETTING = Vignetting()
NEAR_LAMP = NearLampSearch()
HIDDEN_LAMP = HiddenLamp()
CROP = Crop()
BALL_SHADE = BallShade()
SCREEN_SHADE = ScreenShade()
