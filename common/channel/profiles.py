"""Named channels, each with the source of its numbers and a word on what is a choice."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Profile:
    """A channel in the short form, what it stands for, and where its numbers come from."""

    channel: str
    summary: str
    source: str


PROFILES: dict[str, Profile] = {
    "lora": Profile(
        channel="rate:bits_per_second=250;erasure:p=0.15",
        summary="LoRa, spreading factor 12 at 125 kHz, 14 dBm, 2 to 5 km over ground. Choose datagrams of 64 bytes: at "
        "this rate a frame takes at most 51 bytes of LoRaWAN payload.",
        source="Loss: Petäjäjärvi, Mikhaylov, Roivainen, Hänninen, Pettissalo, 'On the coverage of LPWANs: range "
        "evaluation and channel attenuation model for LoRa technology', ITST 2015 (15 % of the packets lost from a car "
        "at 2 to 5 km). Rate: LoRa Alliance, 'LoRaWAN 1.0.3 Regional Parameters', EU863-870, data rate 0.",
    ),
    "geostationary": Profile(
        channel="delay:seconds=0.279;bit_errors:ber=1e-07",
        summary="One hop over a geostationary satellite, from the edge of its view.",
        source="RFC 2488, 'Enhancing TCP over satellite channels using standard mechanisms', section 2: 279.0 ms a hop "
        "at the edge of the view (239.6 ms below the satellite), bit-error rates of 1e-7 or less.",
    ),
    "underwater": Profile(
        channel="rate:bits_per_second=5000;delay:seconds=1.57;rayleigh:ebn0_db=20",
        summary="An acoustic modem at the bottom of 2,362 m of water and a buoy above it; the gain fades from packet "
        "to packet.",
        source="Rate and depth: Frye, Ware, Grund, Partan, Koski, Singh, Freitag, Collins, Detrick, 'An "
        "acoustically-linked deep-ocean observatory', OCEANS 2005. Sound at 1,500 m/s: Stojanovic and Preisig, "
        "'Underwater acoustic communication channels: propagation models and statistical characterization', IEEE "
        "Communications Magazine 47 (1), 2009, which also discusses Rayleigh fading. A choice: 20 dB, no coding.",
    ),
    "wifi": Profile(
        channel="rate:bits_per_second=1000000;gilbert_elliott:p=0.01836,r=0.1746",
        summary="Wi-Fi at 2.4 GHz, frames to a group (never acknowledged, so never sent again) of 256 bytes at 1 "
        "Mbit/s to a walker in the fringe: 10 dB of fading margin, 9.5 % lost in bursts of 5.7.",
        source="Zorzi, Rao and Milstein, 'On the accuracy of a first-order Markov model for data transmission on "
        "fading channels', ICUPC 1995: the chain of a Rayleigh-fading link from its margin F = 10 dB and its Doppler "
        "shift, here 1.4 m/s at 2.437 GHz; 1 Mbit/s is the lowest rate of IEEE 802.11. A choice: margin and speed.",
    ),
}
