// tactomo's C++ client: contacts and pressure maps for a robot controller.
//
//     tactomo::Subscription skin{"left_forearm"};
//     while (running) {
//         const tactomo::Frame* frame = skin.latest();        // never waits, never throws
//         if (!frame || !frame->is_known()) stop();            // not known is not "nothing pressed"
//         else for (const tactomo::Contact& contact : frame->contacts) react(contact);
//     }
//
// The messages behind it are specified in clients/STREAM.md. Needs libzmq with its C++ header and
// msgpack's C++ headers, and nothing of the daemon.
#pragma once

#include "control.hpp"
#include "error.hpp"
#include "frame.hpp"
#include "keys.hpp"
#include "message.hpp"
#include "subscription.hpp"
