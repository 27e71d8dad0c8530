"""How well each drone is estimated, and how well it flies its commands: both against its truth. Pure."""

from typing import NamedTuple

import numpy as np

from zsim.math.frames import wrap_angle
from zsim_analysis.reading.recorded_flight import Array, DroneEstimates, RecordedFlight, Track, VelocityCommands

SIGMAS = 2.0  # half width of the band that is drawn, in standard deviations
DEGREES = 6  # of freedom of a drone's NEES: position and velocity
ESTIMATES_MAX = 200_000  # judged of a flight: a second of work
POSITION, YAW = (0, 1, 2), 3  # columns of errors and velocities: x, y, z, heading


class EstimateErrors(NamedTuple):
    """Estimate − truth of one drone at K instants.

    Attributes:
        t_s: (K,) simulated time.
        error: (K, 4) x, y, z in W [m], heading the short way [rad].
        sigma: (K, 4) standard deviations that the estimator states of them.
        nees: (K,) normalised error squared of position and velocity, eᵀ P⁻¹ e; NaN where P is singular. Its mean is
            DEGREES where the stated covariance is true [Bar-Shalom, Li, Kirubarajan 2001, 5.4.2].
    """

    t_s: Array
    error: Array
    sigma: Array
    nees: Array

    def share_inside(self, rows: np.ndarray) -> Array:
        """Return which share (4,) of the errors at some instants is within SIGMAS standard deviations."""
        return np.mean(np.abs(self.error[rows]) <= SIGMAS * self.sigma[rows], axis=0)


class VelocityResponse(NamedTuple):
    """Commanded and flown velocity of one drone at C instants, a new command each.

    Attributes:
        t_s: (C,) simulated time.
        commanded, flown: (C, 4) forward, left, up [m/s], yaw rate [rad/s]; flown by the true heading.
    """

    t_s: Array
    commanded: Array
    flown: Array


def estimate_errors(flight: RecordedFlight) -> dict[str, EstimateErrors]:
    """Return the errors of the estimates of every drone whose truth is known and that has estimates on record.

    Of very many, at every n-th instant of truth, the same ones of all drones.
    """
    own = {track.name: track for track in flight.tracks if not track.external}
    step = 1 + sum(len(each.t_ns) for each in flight.estimates.values()) // ESTIMATES_MAX
    errors = {name: _errors(own[name], each, step) for name, each in flight.estimates.items() if name in own}
    return {name: errors[name] for name in own if name in errors and len(errors[name].t_s)}


def velocity_responses(flight: RecordedFlight) -> dict[str, VelocityResponse]:
    """Return the velocities of every drone whose truth is known and that was flown by velocity commands."""
    own = {track.name: track for track in flight.tracks if not track.external}
    responses = {name: _response(own[name], each) for name, each in flight.commands.items() if name in own}
    return {name: responses[name] for name in own if name in responses and len(responses[name].t_s)}


def _errors(track: Track, estimates: DroneEstimates, step: int) -> EstimateErrors:
    t_ns, there, here = np.intersect1d(track.t_ns[::step], estimates.t_ns, assume_unique=True, return_indices=True)
    there = there * step
    position = estimates.p_W[here] - track.p_W[there]
    velocity = estimates.v_W[here] - track.truth[there, 3:6]
    yaw = wrap_angle(estimates.yaw[here] - track.yaw[there])
    covariance = estimates.covariance[here]
    variances = np.diagonal(covariance, axis1=1, axis2=2)[:, :3]
    sigma = np.column_stack([np.sqrt(np.maximum(variances, 0.0)), estimates.yaw_sigma[here]])
    error = np.column_stack([position, yaw])
    return EstimateErrors(t_ns / 1e9, error, sigma, nees(np.hstack([position, velocity]), covariance))


def nees(error: Array, covariance: Array) -> Array:
    """Return eᵀ P⁻¹ e (K,) of errors (K, n) and their covariances (K, n, n); NaN where P is not positive definite."""
    values, vectors = np.linalg.eigh(covariance)
    definite = values[:, 0] > 1e-12 * np.maximum(values[:, -1], 1e-30)  # below, the error is divided by rounding
    along = np.einsum("kij,ki->kj", vectors, error)
    squares = np.sum(along**2 / np.where(definite[:, None], values, 1.0), axis=1)
    return np.where(definite, squares, np.nan)


def _response(track: Track, commands: VelocityCommands) -> VelocityResponse:
    t_ns, there, here = np.intersect1d(track.t_ns, commands.t_ns, assume_unique=True, return_indices=True)
    yaw = track.yaw[there]
    flown = np.column_stack([_in_heading(track.truth[there, 3:6], yaw), track.yaw_rate[there]])
    velocity = commands.velocity[here]
    turned = np.where(commands.in_W[here][:, None], _in_heading(velocity, yaw), velocity)
    return VelocityResponse(t_ns / 1e9, np.column_stack([turned, commands.yaw_rate[here]]), flown)


def _in_heading(v_W: Array, yaw: Array) -> Array:
    """Return velocities (K, 3) forward, left and up, of those in W."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * v_W[:, 0] + s * v_W[:, 1], c * v_W[:, 1] - s * v_W[:, 0], v_W[:, 2]])
