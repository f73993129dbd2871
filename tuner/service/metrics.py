"""Metrics for Prometheus: requests, uploads, jobs by state, deaths of workers."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from tuner.service import jobs
from tuner.service.errors import UnavailableError
from tuner.service.service import Service


class Metrics:
    """The counters of one server."""

    def __init__(self, service: Service) -> None:
        self.registry = CollectorRegistry()
        self.registry.register(_Table(service))
        self.seconds = Histogram(
            "tune_request_seconds",
            "Time to answer, by route.",
            ("method", "route", "status"),
            registry=self.registry,
        )
        self.uploaded = Counter(
            "tune_uploaded_bytes", "Bytes of recordings that were received.", registry=self.registry
        )

    def text(self) -> bytes:
        """Return all of them in Prometheus' format."""
        return generate_latest(self.registry)


class _Table(Collector):
    """What the job table and the dispatcher say."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        deaths = CounterMetricFamily("tune_worker_deaths", "Workers that died.")
        deaths.add_metric([], self._service.dispatcher.deaths)
        yield deaths
        up = GaugeMetricFamily("tune_database_up", "Whether the database answers.")
        try:
            found = jobs.counts(self._service.database)
        except UnavailableError:
            found = {}
        up.add_metric([], float(bool(found)))
        yield up
        gauge = GaugeMetricFamily("tune_jobs", "Jobs by state.", labels=["state"])
        for state, count in found.items():
            gauge.add_metric([state], count)
        yield gauge

    def describe(self) -> Iterator[Metric]:
        return iter(())
